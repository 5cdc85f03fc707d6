r"""Phase functions: densities of the angle between the directions of travel before and after scattering.

.. math:: \int_{S^2} p(\omega', \omega)\,d\omega = 1, \qquad g = \int_{S^2} \cos\theta\,p\,d\omega

Conventions. cos is 1 for straight forward scattering; densities are per steradian; ``u`` is uniform in [0, 1), and a larger u
gives a larger cos. Functions take Dr.Jit floats and know nothing of Mitsuba's objects. Values carry derivatives with respect
to the parameters and to the directions; samples are to be drawn detached.
"""

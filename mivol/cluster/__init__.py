"""Runs over the processes of a Dask cluster.

Conventions. One process owns a run: it reads the inputs, sends work, adds results in a fixed order, and writes the run folder.
Workers render and differentiate; they write nothing but a temporary folder of inputs. Random numbers belong to work, not to
workers, so a result does not depend on the number of workers, their order, or a lost worker.

``address`` says where workers are, ``connection`` starts them, ``pool`` sends work to them, ``workplace`` runs inside of them,
``packages`` carries files. Dask is imported only by :func:`mivol.cluster.connection.open_pool`.
"""

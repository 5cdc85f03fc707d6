"""Benchmarks: the speed and accuracy of mivol beside other methods, one study for each subject.

Conventions. ``mivol bench NAME`` runs the study in ``studies/NAME``. A study asks questions. Each question is a function from
an amount of work (:class:`~mivol.bench.harness.study.Size`) to numbers for a JSON file. The full size gives the published
figures. The quick size is for CI, and its times mean nothing. Standard output holds the JSON; progress goes to standard error.
No other room of mivol imports this room, except ``cli/``.

A new study is one file in ``studies/`` with a module docstring, whose first line is a question, and a constant ``STUDY``, its
only public name. Bars on single figures are declared (:class:`~mivol.bench.harness.study.Promise`).

Shared: ``harness`` (contests, bars, command line, figures), ``scenes`` (volumes, lights, and a walk of rays whose rate measures
the speed of a machine) and ``photo_fits``.
"""

"""Measurements beside what else could be used: how fast and how exact mivol is, one module for each question.

Conventions. A bench is a module whose docstring says what is asked and how it is measured; :func:`main` of that module
reads the command line, prints JSON and writes it beside a figure. The scripts ``scripts/bench_*.py`` only call it. A
``Size`` holds how much work is done: FULL is what the README quotes, QUICK is small and its times mean nothing. Contestants
of one question run in turns on the same work (:mod:`mivol.bench.harness.timing`). Progress goes to standard error. No other
room of mivol imports this one.

Shared: timing (clocks and turns), agreement (are two noisy means the same?), bars (a figure beside the value that the
project promises), questions (the command line and the JSON), extinctions and scenes (the work), figures (panels).
"""

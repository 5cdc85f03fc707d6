"""The studies. Each module or package in this folder is one study; :mod:`mivol.bench.harness.catalogue` finds it by its
name."""

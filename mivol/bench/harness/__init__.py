"""The parts that all studies share: contests in rounds, agreement of means, bars, command line, JSON and figures."""

"""What all studies share: contestants in rounds, budgets, bars, the command line, JSON and figures."""

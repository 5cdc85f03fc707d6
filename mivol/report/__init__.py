"""What a run found, said so that others can judge it: the record, its figures, its page, its sources."""

"""The results of a run: record, figures and report page."""

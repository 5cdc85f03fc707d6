"""Is a result right: statistics, reference renders by Mitsuba, doubts about Mitsuba, comparison."""

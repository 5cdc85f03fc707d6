"""Is it right: statistics, reference renders by Mitsuba, where Mitsuba is not to be trusted, comparison."""

"""How light travels: exact segments through fields. No Mitsuba class is defined here."""

"""Each script of this package answers one question by measurements."""

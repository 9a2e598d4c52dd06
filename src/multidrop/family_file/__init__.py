"""Families from files: a register table as TOML, with CSV beside it, becomes a class. No code runs."""

"""Families from files: a register table as TOML and CSV becomes a class of drives. No code runs."""

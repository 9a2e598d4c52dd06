"""Ports, and exchanges on them: the only room of the library that talks to the operating system's ports."""

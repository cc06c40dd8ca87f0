"""Checks of arguments, atomic writes, digests and threads."""

"""Checks of arguments, atomic writes, threads: what every room uses."""

"""Registration as a job: options, photographs and lists, their runs, and files of results.

Each photograph becomes an :class:`.entry.Entry`, which one resumable loop registers, in one process
or several, and whose results one store keeps.
"""

"""The commands of the command line, a file for each kind; ``cli`` registers them.

A command is a function that says what it takes, and leaves the work to the library.  What they
share is in ``options`` (what can be said), ``logs`` (what is read) and ``console`` (what is told).
"""

__all__: list[str] = []

"""A run and the object in it, as scripts, the command line and the viewer hold them."""

from physhandi.data.run import RunFolder


class Run(RunFolder):
    """One execution of the pipeline: its folder, its measures and the object that it fitted."""

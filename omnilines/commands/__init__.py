"""What the command line does: read files, run a pipeline, write files and the page."""

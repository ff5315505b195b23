"""What a result looks like: the sections of its report, its tables, and its figures for `--json`."""

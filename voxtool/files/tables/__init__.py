"""Points and answers as tables, and tars of samples."""

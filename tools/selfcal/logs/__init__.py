"""A file becomes a recording: formats, headings, clock."""

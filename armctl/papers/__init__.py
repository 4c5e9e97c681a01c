"""The five papers recomputed: their tables, figures and errors beside what armctl finds."""

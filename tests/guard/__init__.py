"""What a change of the code's shape must leave as it is: wire bytes, logs and JSON, kept as digests in data files."""

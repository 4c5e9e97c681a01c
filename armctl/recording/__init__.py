"""Logs: MCAP files with ROS 2 messages, written so that a crash costs one second at most.

From a tick to the file: recorder (queue and thread), rotation (which file, and when the next one), writer (one file),
channels (what the messages of a tick are), cdr and shapes (their bytes), chunks (the container), disk (the files).
Back again: log_file (one pass, damage skipped), columns (numpy), reader (all of that by path), timeline (frames).
With whole files: recordings (takes), recover, compact, edit (trim, merge), export, replay, quota.
With folders of them: index (what it keeps of one: entry), search, notes.
"""

"""Notes: people's about logs, in one file beside these, and those in the logs; a line of JSON each.

Little is imported here: what is asked of an index is answered before anything that reads logs is loaded.
"""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from armctl.errors import LogError

NOTES = "notes.jsonl"
NOTE = "NOTE"
LEVELS = {"info": 20, "warning": 30, "error": 40}
NOTE_LEVEL = LEVELS["info"]
# Of a minute of a servo, in the order of its columns (index.sql).
FIGURES = ("temperature_degC", "load_ratio", "load_mean_ratio", "voltage_V", "error_deg")


def parse_note(text: str) -> dict[str, Any]:
    """The JSON object in a line on /armctl/command; empty where it is none."""
    try:
        data = json.loads(text)
        if "\\ud" in text.lower():  # half a surrogate pair, which neither sqlite3 nor a terminal takes
            data = json.loads(json.dumps(data, ensure_ascii=False).encode(errors="replace"))
    except (ValueError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def add_note(log: Path, text: str) -> None:
    """Keep a note about a log, beside it.

    Raises:
        LogError: there is no such log, no word in the note, or it cannot be written.
    """
    if not log.is_file():
        raise LogError(f"{log}: there is no such log")
    if not text.strip():
        raise LogError(f"{log}: a note without a word says nothing; write what to remember")
    line = json.dumps({"log": log.name, "text": text}) + "\n"
    from armctl.recording.disk import writing

    path = log.parent / NOTES
    with writing(path), path.open("a", encoding="utf-8") as file:
        file.write(line)  # in one write, so that two who note at once do not mix


def notes(folder: Path) -> list[tuple[str, str]]:
    """Name of a log and text of every note in a folder; lines that are none are passed over."""
    found = []
    with suppress(OSError):
        for line in (folder / NOTES).read_text(encoding="utf-8", errors="replace").splitlines():
            note = parse_note(line)
            if isinstance(note.get("log"), str) and isinstance(note.get("text"), str):
                found.append((note["log"], note["text"]))
    return found

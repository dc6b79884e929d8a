"""Rows of a benchmark in a file (JSON Lines), so that a run that was stopped goes on where it was."""

import json


class Rows:
    """The rows that a file has, and those that are added to it."""

    def __init__(self, path):
        self._path = path
        self.rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def __iter__(self):
        return iter(self.rows)

    def add(self, row):
        self.rows.append(row)
        with self._path.open("a") as file:
            file.write(json.dumps(row) + "\n")

#!/usr/bin/env python3
"""Run the commands of the pages that take too long for a test, as they are printed, one after the other.

    scripts/long_commands.py                  # hours
    scripts/long_commands.py --only 'mivol demo*'
    scripts/long_commands.py --list

They are the table ``long`` of tests/printed_commands.toml. Each runs in this checkout, whose .venv is made by ./scripts/test.
Prints JSON: exit code and seconds of each; what a command says goes to the error output. Ends with 1 where one of them fails.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
import tomllib
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "tests" / "printed_commands.toml"


def main(argv: list[str] | None = None) -> int:
    """Run the commands that the command line asks for; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="GLOB", default="*", help="commands that match this pattern")
    parser.add_argument("--list", action="store_true", help="name them, and run none")
    args = parser.parse_args(argv)
    commands = [command for command in tomllib.loads(TABLE.read_text(encoding="utf-8"))["long"] if fnmatch(command, args.only)]
    if not commands:
        parser.error(f'no command of the table "long" of {TABLE.name} matches {args.only!r}; --list names them')
    if args.list:
        print("\n".join(commands))
        return 0
    found = {command: run(command) for command in commands}
    print(json.dumps(found, indent=2))
    return 1 if any(one["exit_code"] for one in found.values()) else 0


def run(command: str) -> dict[str, float]:
    """Run a command as a shell in this checkout would; its exit code and seconds."""
    print(f"$ {command}", file=sys.stderr, flush=True)
    programs = ROOT / ".venv" / ("Scripts" if os.name == "nt" else "bin")
    environment = {**os.environ, "PATH": os.pathsep.join([str(programs), os.environ.get("PATH", "")])}
    words, started = shlex.split(command), time.monotonic()
    if words[0].endswith(".py"):  # as its first line says, where the system does not read that: by the checkout's Python
        words = ["python", *words]
    code = subprocess.run(words, cwd=ROOT, env=environment, stdout=sys.stderr, check=False).returncode
    return {"exit_code": code, "seconds": round(time.monotonic() - started, 1)}


if __name__ == "__main__":
    sys.exit(main())

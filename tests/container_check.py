"""Builds the Dockerfile without Docker: its steps in a new Debian, and looks at its server.

    python tests/container_check.py FOLDER [--bind PATH ...] [--arg NAME=VALUE ...]

needs root and debootstrap. FOLDER gets the system (6 GB at most) and must not exist. Paths that are
bound are seen inside where they are here, to be read only: a pip configuration, a folder of wheels,
``/usr/local/share/ca-certificates``.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
PATIENCE_S = 180.0


def steps(dockerfile: str) -> Iterator[tuple[str, str]]:
    """List instructions and what follows them; lines that end with a backslash go on."""
    lines = [line for line in dockerfile.splitlines() if not line.lstrip().startswith("#")]
    for line in re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines():
        if line.strip():
            word, _, rest = line.partition(" ")
            yield word, rest.strip()


@contextmanager
def mounted(source: str, target: Path, *options: str) -> Iterator[None]:
    """Mount something into the new system for a while."""
    if not Path(source).is_file():
        target.mkdir(parents=True, exist_ok=True)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.touch()
    subprocess.run(["mount", *options, source, str(target)], check=True)
    try:
        if "--bind" in options and source != "/dev":
            # Steps write where their system keeps things, which must not change this machine's.
            subprocess.run(["mount", "-o", "remount,bind,ro", str(target)], check=True)
        yield
    finally:
        subprocess.run(["umount", str(target)], check=True)


class Container:
    """A new system, and what the Dockerfile has said so far of whom to be and what to know."""

    def __init__(self, root: Path, arguments: dict[str, str]) -> None:
        self.root = root
        self.variables = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}
        self.user, self.work = "root", "/"
        self._arguments = arguments

    def start(self, command: list[str], *, knows_arguments: bool = False) -> subprocess.Popen[str]:
        """Start something inside."""
        told = {k: v for k, v in os.environ.items() if k.startswith(("PIP_", "SSL_"))}
        told |= self.variables | (self._arguments if knows_arguments else {})
        inside = ["chroot", f"--userspec={self.user}", str(self.root)]
        # `env -C` enters the folder; HOME is the user's.
        home = "/root" if self.user == "root" else f"/home/{self.user}"
        pairs = [f"{name}={value}" for name, value in (told | {"HOME": home}).items()]
        return subprocess.Popen(
            [*inside, "/usr/bin/env", "-i", "-C", self.work, *pairs, *command],
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def run(self, command: list[str], *, knows_arguments: bool = False) -> str:
        """Do something inside; what it prints is given."""
        process = self.start(command, knows_arguments=knows_arguments)
        printed, _ = process.communicate()
        if process.returncode:
            raise SystemExit(f"{shlex.join(command)} ended with {process.returncode}:\n{printed}")
        return printed

    def obey(self, word: str, rest: str) -> None:
        """Follow an instruction."""
        if word == "RUN":
            start = time.monotonic()
            self.run(["/bin/sh", "-c", rest], knows_arguments=True)
            print(f"{time.monotonic() - start:6.0f} s  {rest[:90]}", flush=True)
        elif word == "COPY":
            *sources, target = rest.split()
            place = self.root / target.lstrip("/")
            for source in sources:
                if (ROOT / source).is_dir():
                    ignored = shutil.ignore_patterns("__pycache__")
                    shutil.copytree(ROOT / source, place, ignore=ignored)
                else:
                    place.mkdir(parents=True, exist_ok=True)
                    shutil.copy(ROOT / source, place)
        elif word in {"ENV", "ARG"}:
            name, _, value = rest.partition("=")
            (self.variables if word == "ENV" else self._arguments).setdefault(name, value)
            if word == "ENV":
                self.variables[name] = value
        elif word == "USER":
            self.user = rest
        elif word == "WORKDIR":
            self.work = rest
        elif word not in {"FROM", "VOLUME", "EXPOSE", "HEALTHCHECK", "ENTRYPOINT", "CMD"}:
            raise SystemExit(f"{word} of the Dockerfile is not known here")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bind", type=Path, action="append", default=[])
    parser.add_argument("--arg", action="append", default=[])
    asked = parser.parse_args()
    said = list(steps((ROOT / "Dockerfile").read_text()))
    base = dict(said)["FROM"]
    suite = re.fullmatch(r"debian:(\w+)-slim", base)
    if suite is None:
        raise SystemExit(f"{base} is no Debian, of which debootstrap makes a new one")
    root: Path = asked.folder.resolve()
    made = ["debootstrap", "--variant=minbase", suite[1], str(root)]
    subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
    container = Container(root, dict(text.split("=", 1) for text in asked.arg))
    with ExitStack() as stack:
        stack.enter_context(mounted("proc", root / "proc", "-t", "proc"))
        for path in ("/dev", "/etc/resolv.conf", *map(str, asked.bind)):
            stack.enter_context(mounted(path, root / path.lstrip("/"), "--bind"))
        for word, rest in said:
            container.obey(word, rest)
        words = dict(said)
        command = [*json.loads(words["ENTRYPOINT"]), *json.loads(words["CMD"])]
        healthy = words["HEALTHCHECK"].partition("CMD ")[2]
        watch(container, command, healthy)
    print("The container builds, serves as its user, is healthy, and ends when it is asked to.")


def watch(container: Container, command: list[str], healthy: str) -> None:
    """Start the server, wait until it is healthy, look at who it is, and end it."""
    server = container.start(command)
    try:
        end = time.monotonic() + PATIENCE_S
        check = container.start(["/bin/sh", "-c", healthy])
        while check.wait():
            if server.poll() is not None or time.monotonic() > end:
                raise SystemExit("The server was not healthy in time.")
            time.sleep(1.0)
            check = container.start(["/bin/sh", "-c", healthy])
        print(container.run(["physhandi", "doctor"]))
        status = Path(f"/proc/{server.pid}/status").read_text()
        if re.search(r"^Uid:\s+0\b", status, re.MULTILINE):
            raise SystemExit("The server runs as root.")
        server.send_signal(signal.SIGTERM)
        if server.wait(60) not in {0, 143, -signal.SIGTERM}:
            raise SystemExit(f"The server ended with {server.returncode}.")
    finally:
        server.kill()


if __name__ == "__main__":
    sys.exit(main())

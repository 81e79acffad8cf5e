"""`olpm-bench ARGUMENTS`, but what it writes below a folder is counted, and at one of these events it ends as by kill -9.

    python killed.py FOLDER AT COUNT ARGUMENTS...

AT: the number of the event, from 1; 0: none.  COUNT: the file that gets the number of events.  An event is the opening of a file
for writing, by its name or its number, a new folder, a link, a renaming, a removal; it is counted before it happens.
"""
import os
import signal
import sys

EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link"}
folder, at, count, *arguments = sys.argv[1:]
below, at, seen = os.path.abspath(folder) + os.sep, int(at), 0


def event(name: str, arguments: tuple) -> None:
    global seen
    if name not in EVENTS or (name == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR)):
        return
    file = arguments[0]
    path = os.readlink(f"/proc/self/fd/{file}") if isinstance(file, int) else os.path.abspath(os.fsdecode(file))
    if path.startswith(below):
        seen += 1
        if seen == at:
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    sys.addaudithook(event)
    sys.argv = ["olpm-bench", *arguments]
    from olpm_bench.cli import main
    try:
        main()
    finally:
        with open(count, "w") as file:
            file.write(str(seen))

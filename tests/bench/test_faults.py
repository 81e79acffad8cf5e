"""Full disks, read-only folders, broken files, clocks that jump, processes that hang or are interrupted: nothing false is kept,
and what is said names the file and what happens next.  Kill -9 is in test_kills.py."""
from __future__ import annotations

import contextlib
import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small_experiment import TOML
from typer.testing import CliRunner

from olpm_bench.bench import experiment_file, files, lock, submit
from olpm_bench.bench.accumulator import Accumulator
from olpm_bench.bench.clock import Clock
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.lock import LockedError
from olpm_bench.bench.reference_file import Reference, read_reference, write_reference
from olpm_bench.bench.results import Cell, Results
from olpm_bench.cli import app

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("door_ajar", "GMM", 3)
BARE = TOML.replace("max_depth", 'reference = "none"\nmax_depth')
SHORT = BARE.replace("seeds = 2", "seeds = 1")


def image(h=9, w=16, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).random((h, w, 3), dtype=np.float32)


def write_cell(results: Results, seed=0) -> Cell:
    layers = {"mean": image(seed=seed), "variance": np.full((9, 16, 3), np.inf), "count": np.full((9, 16), 8)}
    info = {"key": f"k{seed}", "charged_seconds": 15.25, "spp": 8}
    return results.write_cell(*NAMES, info, [{"seconds": 0.5, "spp": 4}, {"seconds": 1.5, "spp": 8}], layers,
                              [image(seed=seed), image(seed=seed)], {"title": "a test"})


def files_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def python(code: str, *arguments: object, **options) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)], text=True, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)}, **options)


# ---------------------------------------------------------------- broken files

def mutations(content: bytes, n: int):
    """`content` cut short, or with a byte changed, in n ways."""
    rng = random.Random(len(content))
    for i in range(n):
        at = rng.randrange(len(content))
        yield content[:at] if i % 2 else content[:at] + bytes([content[at] ^ rng.randrange(1, 256)]) + content[at + 1:]


@pytest.mark.parametrize("name", ["image.exr", "checkpoints.exr", "trace.jsonl", "cell.json"])
def test_what_a_disk_has_changed_is_not_believed(tmp_path, name, capfd):
    """OpenEXR alone reads 4 of 10 such files without a complaint, and pixels that nobody has rendered from most of these."""
    results = Results(tmp_path)
    whole = write_cell(results)
    image, checkpoints, content = whole.image(), whole.checkpoints(), (whole.folder / name).read_bytes()
    refused = 0
    for changed in mutations(content, 60):
        (whole.folder / name).write_bytes(changed)
        try:
            cell = results.read_cell(*NAMES)
            found, on_the_way = cell.image(), cell.checkpoints()
        except ResultError as error:
            assert str(whole.folder) in str(error) and ("broken" in str(error) or "schema_version" in str(error))
            refused += 1
            continue
        key = {"key": cell.info["key"]}             # is compared with the experiment's
        assert cell.info | key == whole.info | key and cell.trace == whole.trace
        assert all(np.array_equal(found[part], image[part]) for part in image)
        assert all(map(np.array_equal, on_the_way, checkpoints))
    assert refused > 40


@pytest.mark.parametrize("name", ["reference.exr", "meta.json"])
def test_a_broken_reference_is_refused_and_its_remedy_named(tmp_path, name, capfd):
    halves = [image(seed=i) for i in range(4)]
    write_reference(tmp_path / "k", Reference(*halves, {"spp_a": 3, "spp_b": 1, "passes_a": 3, "passes_b": 3, "seconds": 1.0}))
    whole, content, refused = read_reference(tmp_path / "k", 16, 9), (tmp_path / "k" / name).read_bytes(), 0
    for changed in mutations(content, 60):
        (tmp_path / "k" / name).write_bytes(changed)
        try:
            again = read_reference(tmp_path / "k", 16, 9)
        except ResultError as error:
            assert "remove the folder and make it again" in str(error) or "is newer" in str(error)
            refused += 1
            continue
        assert all(np.array_equal(getattr(again, half), getattr(whole, half)) for half in ("a", "b", "a_variance", "b_variance"))
        assert (again.meta["spp_a"], again.meta["spp_b"]) == (3, 1)
    assert refused > 25         # all that meta.json says is in the image, too


# ---------------------------------------------------------------- disks

def on_a_disk(mount: str, command: list[str], folder: Path) -> subprocess.CompletedProcess[str] | None:
    """Run a command in `folder`, in a mount namespace of its own after `mount`; None if there can be none."""
    script = f"cd / && {mount} && cd {folder} && echo mounted >&2 && exec \"$@\""
    enter = [*(["unshare", "-m"] if os.geteuid() == 0 else ["unshare", "-rm"]), "sh", "-c", script, "sh", *command]
    if shutil.which("unshare") is None:
        return None
    done = subprocess.run(enter, text=True, capture_output=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=300)
    first, _, done.stderr = done.stderr.partition("\n")
    return done if first == "mounted" else None


FILL = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from test_faults import NAMES, files_in, write_cell
from olpm_bench.bench.lock import locked
from olpm_bench.bench.results import Results
for disk in sys.argv[3:]:
    if sys.argv[2] == "limited":
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(disk) * 64, resource.RLIM_INFINITY))
    results, complete = Results(disk), None
    folder = results.cell_folder(*NAMES)
    try:
        for made in range(100):
            with locked(folder):
                complete = write_cell(results, seed=made).info["key"]
            (Path(disk) / f"ballast{made}").write_bytes(bytes(400 * made))
    except OSError as error:
        said = f"{error.filename}: {error.strerror}"
    cell = results.verified_cell(*NAMES)
    assert cell is None and complete is None or cell.info["key"] == complete, (disk, complete)
    print(said, ",".join(files_in(folder)))
"""


def test_a_full_disk_leaves_the_last_complete_cell(tmp_path):
    """Disks of so many KiB, on each of which a cell is made again and again, until there is no room for the next; if there can be
    no such disks, the size of a file is limited."""
    sizes = range(12, 68, 4)
    for size in sizes:
        (tmp_path / str(size)).mkdir()
    fill = [sys.executable, "-c", FILL, str(Path(__file__).parent)]
    mount = " && ".join(f"mount -t tmpfs -o size={size}k none {tmp_path / str(size)}" for size in sizes)
    done = on_a_disk(mount, [*fill, "full", *map(str, sizes)], tmp_path)
    if done is None:
        done = subprocess.run([*fill, "limited", *map(str, sizes)], text=True, capture_output=True, cwd=tmp_path, timeout=300,
                              env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == len(sizes)
    for line in lines:
        assert "No space left on device" in line or "File too large" in line
        assert ".tmp" not in line and "None" not in line and "lock" not in line.split()[-1]
    assert len({line.split(":")[0].partition("/")[2] for line in lines}) > 3       # it was full at different moments
    assert any(line.endswith("cell.json,checkpoints.exr,image.exr,trace.jsonl") for line in lines)


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_a_figure_on_a_full_disk_is_an_os_error(tmp_path, suffix):
    """Matplotlib, writing a PDF by itself, hides it behind an AttributeError."""
    (folder := tmp_path / "figures").mkdir()
    draw = ("import sys, pathlib; from matplotlib.figure import Figure; from olpm_bench.report import figures\n"
            "figure = Figure(); figure.gca().plot(range(9))\n"
            "try: figures.write(figure, pathlib.Path(sys.argv[1]))\n"
            "except OSError as error: print(error.strerror)")
    out = folder / f"figure.{suffix}"
    done = on_a_disk(f"mount -t tmpfs -o size=4k none {folder}", [sys.executable, "-c", draw, str(out)], tmp_path)
    if done is None:
        pytest.skip("there can be no such disk here")
    assert done.stdout == "No space left on device\n", done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("size", [4, 12, 48, 160])
def test_commands_on_a_full_disk_say_so_in_a_line(tmp_path, size):
    """Disks of so many KiB, which are full with the first file, with some cell, or with the figures."""
    (results := tmp_path / "results").mkdir()
    for command, content in ((["reference", "--seconds", "1"], TOML), (["run"], BARE)):
        (tmp_path / "test.toml").write_text(content)
        script = [sys.executable, "-m", "olpm_bench.cli", *command, str(tmp_path / "test.toml"), "--results", str(results)]
        if (done := on_a_disk(f"mount -t tmpfs -o size={size}k none {results}", script, tmp_path)) is None:
            pytest.skip("there can be no such disk here")
        assert done.returncode in (0, 1, 2) and "Traceback" not in done.stderr and ".tmp" not in done.stderr, done.stderr
        assert (done.returncode == 0) == ("No space left on device" not in done.stderr), done.stderr
        assert done.returncode or size > 12


def test_a_read_only_folder_is_one_line_and_at_once(tmp_path):
    """`run` and `render` say so before they render.  Root may write where a mode says no: the folder is mounted read-only, or, if
    there can be no mount, it is /sys, where nobody makes files."""
    (tmp_path / "test.toml").write_text(BARE)
    (results := tmp_path / "results").mkdir()
    mount = f"mount --bind {results} {results} && mount -o remount,bind,ro {results}"
    for arguments in (["run", str(tmp_path / "test.toml"), "--results", "{}"],
                      ["render", "cornell_box", "--method", "unguided", "--spp", "1", "--out", "{}/x.exr"]):
        command, folder = [sys.executable, "-m", "olpm_bench.cli", *arguments], results
        done = on_a_disk(mount, [word.format(folder) for word in command], tmp_path)
        if done is None:
            folder = Path("/sys")
            done = subprocess.run([word.format(folder) for word in command], text=True, capture_output=True, timeout=300,
                                  env={**os.environ, "PYTHONPATH": str(ROOT)})
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
        assert done.stderr.startswith(f"olpm-bench: {folder}") and ".tmp" not in done.stderr
        assert done.stderr.rstrip().endswith(("Read-only file system", "Permission denied", "Operation not permitted"))
    assert list(results.iterdir()) == []


def test_a_guide_or_image_that_cannot_be_written_is_named_before_the_rendering(tmp_path, monkeypatch):
    from olpm_bench.bench import render_one

    def read_only(**options):
        raise OSError(30, "Read-only file system", str(options["dir"] / "tmpx"))

    monkeypatch.setattr(render_one, "warm_up", lambda *_: pytest.fail("rendered"))
    monkeypatch.setattr(files.tempfile, "TemporaryFile", read_only)
    done = CliRunner().invoke(app, ["render", "cornell_box", "--method", "unguided", "--spp", "1", "--out", f"{tmp_path}/x.exr"])
    assert done.exit_code == 2 and done.stderr == f"olpm-bench: {tmp_path}: Read-only file system\n"


# ---------------------------------------------------------------- clocks

def test_no_step_of_the_clock_frees_a_lock(tmp_path, monkeypatch):
    """A day forwards and backwards, as the system's time, the files' and the start of the machine say it."""
    import psutil

    with lock.locked(tmp_path):
        for days in (-1, 1, 400):
            with monkeypatch.context() as jump:
                now, boot = time.time(), psutil.boot_time()
                jump.setattr(time, "time", lambda now=now, days=days: now + 86400 * days)
                jump.setattr(psutil, "boot_time", lambda boot=boot, days=days: boot + 86400 * days)
                os.utime(tmp_path / "lock", (now - 86400 * days,) * 2)
                with pytest.raises(LockedError, match=f"held by process {os.getpid()} on .* whose last sign of life was 0 s ago"):
                    lock.locked(tmp_path).__enter__()
    assert list(tmp_path.iterdir()) == []


def test_no_step_of_the_clock_is_charged(tmp_path, monkeypatch):
    """An experiment while the wall clock jumps by hours, also in the middle of laps."""
    from olpm_bench.bench import run

    (tmp_path / "test.toml").write_text(SHORT)
    rng, now, steps = random.Random(1), time.time, []

    def jumping() -> float:
        steps.append(rng.uniform(-1e5, 1e5))
        return now() + steps[-1]

    monkeypatch.setattr(time, "time", jumping)
    clock, start = Clock(), time.perf_counter()
    for _ in range(20):
        with clock.lap("render"):
            time.time()
    elapsed = time.perf_counter() - start
    assert 0 <= clock.charged <= clock.total.wall <= elapsed
    start = time.perf_counter()
    assert run.run(experiment_file.load(tmp_path / "test.toml"), tmp_path / "results") == []
    elapsed = time.perf_counter() - start
    for spec in experiment_file.load(tmp_path / "test.toml").cells():
        cell = Results(tmp_path / "results" / "test").verified_cell(spec.scene.name, spec.method.name, spec.seed)
        assert 0 < cell.info["charged_seconds"] <= cell.info["wall_seconds"] <= elapsed


def test_a_clock_that_stands_still_charges_nothing(monkeypatch):
    clock = Clock(count_wait=False)
    monkeypatch.setattr(time, "perf_counter", lambda: 7.0)
    with clock.lap("train", lambda: 1.0):
        pass
    assert clock.charged == 0 and clock.total.compile == 0


# ---------------------------------------------------------------- processes that hang

HOLD = """
import sys, time
from pathlib import Path
from olpm_bench.bench import lock
lock.BEAT = 0
with lock.locked(Path(sys.argv[1])) as alive:
    print("held", flush=True)
    while True:
        alive()
        time.sleep(0.01)
"""


def test_who_hangs_loses_the_lock_and_notices(tmp_path, monkeypatch):
    """A process that is stopped, and goes on after another has taken its cell."""
    holder = python(HOLD, tmp_path)
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(LockedError, match=f"held by process {holder.pid} "):
            lock.locked(tmp_path).__enter__()
        holder.send_signal(signal.SIGSTOP)
        while lock.silence(tmp_path) < 0.3:
            time.sleep(0.05)
        with pytest.raises(LockedError, match="after 30 minutes without one it is taken over"):
            lock.locked(tmp_path).__enter__()
        monkeypatch.setattr(lock, "LEASE", 0.2)
        with lock.locked(tmp_path):
            holder.send_signal(signal.SIGCONT)
            _, errors = holder.communicate(timeout=60)
            assert "lock was lost to another process" in errors.splitlines()[-1]
            assert json.loads((tmp_path / "lock").read_text())["pid"] == os.getpid()
    finally:
        holder.kill()
        holder.communicate()
    assert list(tmp_path.iterdir()) == []


def test_a_zombie_holds_nothing(tmp_path):
    """Killed, and not yet asked for by its parent: its number is taken, but it is dead."""
    holder = python(HOLD, tmp_path)
    assert holder.stdout.readline() == "held\n"
    holder.kill()
    os.waitid(os.P_PID, holder.pid, os.WEXITED | os.WNOWAIT)
    assert lock.silence(tmp_path) == math.inf
    with lock.locked(tmp_path):
        pass
    holder.communicate()


@pytest.mark.parametrize("name", ["run.measure", "results.write_exr"])
def test_who_has_lost_a_cell_does_not_write_it(tmp_path, monkeypatch, name):
    """Lost while it was measured, or while its images were written beside their place."""
    from olpm_bench.bench import results, run

    (tmp_path / "test.toml").write_text(SHORT)
    folder = Results(tmp_path / "results" / "test").cell_folder("cornell_box", "Roulette", 0)
    original = {"run.measure": run.measure, "results.write_exr": results.write_exr}[name]

    def hangs(what, *arguments, **options):
        done = original(what, *arguments, **options)
        if str(what) == "cornell_box / Roulette / seed 0" or folder in getattr(what, "parents", ()):
            (folder / "lock").write_bytes(lock._signed({**lock._identity(), "pid": 1}))       # of the thief
        return done
    monkeypatch.setattr(f"olpm_bench.bench.{name}", hangs)
    (problem,) = run.run(experiment_file.load(tmp_path / "test.toml"), tmp_path / "results")
    assert problem.startswith("cornell_box / Roulette / seed 0: ") and "was lost to another process" in problem
    assert files_in(folder) == ["lock"]


class Job:
    """A worker of submitit that ends when it is cancelled."""

    def __init__(self, result: list[str] | None = None) -> None:
        self.answer, self.cancelled = result, False

    def done(self) -> bool:
        return self.answer is not None or self.cancelled

    def cancel(self, check: bool) -> None:
        self.cancelled = True

    def exception(self) -> None:
        return None

    def result(self) -> list[str]:
        return self.answer


@pytest.mark.parametrize("jobs, held, patience", [
    ([Job(), Job([])], True, submit.GRACE), ([Job(), Job()], True, lock.LEASE), ([Job(), Job()], False, lock.LEASE)],
    ids=["another has found all complete", "who holds a cell shows no sign of life", "nobody ever takes a cell"])
def test_workers_that_hang_are_stopped(tmp_path, monkeypatch, jobs, held, patience, capfd):
    (tmp_path / "test.toml").write_text(TOML)
    loaded, slept = experiment_file.load(tmp_path / "test.toml"), []
    folder = Results(tmp_path / "test").cell_folder("cornell_box", "Roulette", 1)
    folder.mkdir(parents=True)
    now = time.monotonic()
    if held:
        (folder / "lock").write_bytes(lock._signed({**lock._identity(), "numbers": "a container's"}))
    monkeypatch.setattr(submit.time, "monotonic", lambda: now + submit.POLL * len(slept))
    monkeypatch.setattr(submit.time, "sleep", slept.append)
    submit.wait(jobs, loaded, tmp_path)
    running = [job for job in jobs if job.answer is None]
    assert all(job.cancelled for job in running) and not any(job.cancelled for job in jobs if job not in running)
    assert f"{len(running)} of 2 workers hang and are stopped" in capfd.readouterr().err
    assert len(slept) == pytest.approx(1 + patience / submit.POLL, abs=2)


def test_whom_a_worker_waits_for_is_shown(tmp_path, monkeypatch):
    from olpm_bench.bench import progress, run

    (tmp_path / "test.toml").write_text(SHORT)
    other = lock.locked(Results(tmp_path / "results" / "test").cell_folder("cornell_box", "Roulette", 0))
    other.__enter__()
    shown: list[str] = []
    monkeypatch.setattr(progress.Bar, "at", lambda bar, done, label: shown.append(label))
    monkeypatch.setattr(run, "time", SimpleNamespace(sleep=lambda seconds: other.__exit__(None, None, None)))
    assert run.run(experiment_file.load(tmp_path / "test.toml"), tmp_path / "results", together=True) == []
    (waiting,) = [label for label in shown if label.startswith("waiting for")]
    assert "Roulette / seed 0" in waiting and f"held by process {os.getpid()}" in waiting and "taken over" in waiting


@pytest.mark.slow
def test_two_runs_at_once_share_the_cells(tmp_path):
    """Each cell is done by one of them; who finds a cell in other hands says so and exits with 1."""
    (tmp_path / "test.toml").write_text(BARE.replace("seeds = 2", "seeds = 3"))
    command = [sys.executable, "-m", "olpm_bench.cli", "run", str(tmp_path / "test.toml"), "--results", str(tmp_path / "results")]
    both = [subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                             env={**os.environ, "PYTHONPATH": str(ROOT)}) for _ in range(2)]
    errors = [process.communicate(timeout=500)[1] for process in both]
    done = re.findall(r"\[\d+/\d+\] (cornell_box / .* / seed \d): 11 spp", "".join(errors))
    assert sorted(done) == sorted(str(spec) for spec in experiment_file.load(tmp_path / "test.toml").cells())
    for process, said in zip(both, errors, strict=True):
        assert process.returncode == 0 or (process.returncode == 1 and "is held by process" in said), said
        assert "Traceback" not in said
    assert not [name for name in files_in(tmp_path) if ".tmp" in name or name.endswith("lock")]


# ---------------------------------------------------------------- interruptions

INTERRUPT_AT = {"left": 0, "below": ""}


def _interrupt(name: str, arguments: tuple) -> None:
    """An audit hook: raises KeyboardInterrupt at the event of that number below the folder."""
    if INTERRUPT_AT["left"] > 0 and name in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link") \
            and str(arguments[0]).startswith(INTERRUPT_AT["below"]):
        INTERRUPT_AT["left"] -= 1
        if INTERRUPT_AT["left"] == 0:
            raise KeyboardInterrupt


def test_ctrl_c_at_any_write_leaves_the_old_cell_or_the_new_one(tmp_path):
    """Or none, between the two; never a part of one, and no unfinished file."""
    sys.addaudithook(_interrupt)
    results, outcomes = Results(tmp_path), []
    INTERRUPT_AT["below"] = str(tmp_path)
    for at in range(1, 1000):
        with lock.locked(results.cell_folder(*NAMES)):
            write_cell(results, seed=0)
        INTERRUPT_AT["left"] = at
        try:
            with lock.locked(results.cell_folder(*NAMES)) as alive:
                alive(at_once=True)
                write_cell(results, seed=1)
        except KeyboardInterrupt:
            pass
        else:
            break
        finally:
            reached = INTERRUPT_AT["left"] == 0
            INTERRUPT_AT["left"] = 0
        assert reached
        cell = results.verified_cell(*NAMES)
        outcomes.append(cell.info["key"] if cell is not None else None)
        if cell is not None:
            assert np.array_equal(cell.image()["mean"], image(seed=int(cell.info["key"][1:])))
        assert not [path for path in tmp_path.rglob("*") if ".tmp" in path.name or path.name == "lock"], at
    assert len(outcomes) > 20 and set(outcomes) >= {"k0", "k1", None}
    changes = [a for a, b in zip([*outcomes, ""], ["", *outcomes], strict=True) if a != b and a != ""]
    assert changes[0] == "k0" and changes[-1] == "k1"


def test_ctrl_c_at_any_write_leaves_the_old_reference_or_the_new_one(tmp_path):
    """Whose halves, variances and samples are of one moment."""
    sys.addaudithook(_interrupt)
    images = [image(seed=i) for i in range(8)]
    INTERRUPT_AT["below"], outcomes = str(tmp_path), []
    for at in range(1, 1000):
        for halves, spp in ((images[:4], 3), (images[4:], 5)):
            INTERRUPT_AT["left"] = at if spp == 5 else 0
            with contextlib.suppress(KeyboardInterrupt):
                write_reference(tmp_path / "k", Reference(*halves, {"spp_a": spp, "spp_b": spp}))
        if INTERRUPT_AT["left"]:        # there are fewer
            break
        found = read_reference(tmp_path / "k", 16, 9)
        outcomes.append(spp := found.meta["spp_a"])
        expected = images[:4] if spp == 3 else images[4:]
        assert found.meta["spp_b"] == spp
        assert all(map(np.array_equal, (found.a, found.b, found.a_variance, found.b_variance), expected))
        assert not [path for path in tmp_path.rglob("*") if ".tmp" in path.name], at
    INTERRUPT_AT["left"] = 0
    assert len(outcomes) > 5 and outcomes == sorted(outcomes) and set(outcomes) == {3, 5}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
@pytest.mark.parametrize("command, hint", [("run", "what is complete is kept, and the same command goes on from there"),
                                           ("check", "the same command starts again")])
def test_an_interrupted_command_says_how_to_go_on(tmp_path, monkeypatch, number, command, hint):
    from olpm_bench.bench import run
    from olpm_bench.check import suite

    def interrupted(*args, **kwargs):
        os.kill(os.getpid(), number)
        time.sleep(60)
    (tmp_path / "test.toml").write_text(BARE)
    monkeypatch.setattr(run, "measure", interrupted)
    monkeypatch.setattr(suite, "named", interrupted)
    run_it = ["run", f"{tmp_path}/test.toml", "--results", f"{tmp_path}/results"]
    before = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    found = signal.signal(number, before)           # a test in the background ignores SIGINT
    done = CliRunner().invoke(app, run_it if command == "run" else ["check", "cosine"])
    assert done.exit_code == 130 and done.stderr.splitlines()[-1] == f"olpm-bench: interrupted; {hint}"
    assert signal.signal(number, found) is before
    assert not [name for name in files_in(tmp_path) if ".tmp" in name or name.endswith("lock")]


def test_a_torn_pass_never_enters_a_reference(monkeypatch):
    """Ctrl-C between any two steps of adding a pass: the counts and the mean are of the same passes."""
    accumulator = Accumulator.empty(2, 3)
    accumulator.add(np.ones((2, 3, 3)), 4)

    class Interrupting(np.ndarray):
        def __array_finalize__(self, other):
            if other is not None and other.shape == (2, 3, 3):
                Interrupting.left -= 1
                if Interrupting.left == 0:
                    raise KeyboardInterrupt
    interrupted = 0
    for left in range(1, 20):
        Interrupting.left = 0
        pixels = np.full((2, 3, 3), 3.0).view(Interrupting)
        Interrupting.left = left
        before = (accumulator.mean.copy(), accumulator.square_m2.copy(), accumulator.spp, accumulator.passes)
        try:
            accumulator.add(pixels, 4)
        except KeyboardInterrupt:
            interrupted += 1
            assert (accumulator.spp, accumulator.passes) == before[2:]
            assert np.array_equal(accumulator.mean, before[0]) and np.array_equal(accumulator.square_m2, before[1])
        else:
            break
    assert interrupted > 2


# ---------------------------------------------------------------- what is left of the dead

def test_unfinished_files_of_the_dead_go_and_those_of_the_living_stay(tmp_path):
    """Those of another machine, or of a container with its own process numbers, when they are silent for half an hour."""
    dead = python("")
    dead.communicate()
    here, silent = files.writer().rpartition("-")[0], f".sheet.png.beef-{dead.pid}.tmp.png"
    left = [f".experiment.toml.{here}-{dead.pid}.tmp.toml", f".gains.png.{here}-{dead.pid}.tmp.png", silent]
    kept = [f".summary.json.{here}-{os.getpid()}.tmp.json", f".env.json.beef-{dead.pid}.tmp.json", "notes.tmp", ".notes.tmp"]
    for name in left + kept:
        (tmp_path / name).touch()
    for name in (silent, ".notes.tmp"):
        os.utime(tmp_path / name, (time.time() - 2 * lock.LEASE,) * 2)
    lock.remove_unfinished(tmp_path)
    assert files_in(tmp_path) == sorted(kept)


def test_the_name_of_an_unfinished_file_tells_whose_process_number_it_holds(monkeypatch):
    here, name = files.here(), files.writer()
    for part in here:
        monkeypatch.setattr(files, "here", lambda part=part: here | {part: "another"})
        assert files.writer() != name and files.writer().endswith(f"-{os.getpid()}")


def test_a_complete_cell_is_freed_from_who_was_killed_with_it(tmp_path):
    """Killed between the last file of a cell and the end of its lock; a lock of the living stays."""
    folder = write_cell(Results(tmp_path)).folder
    whole = files_in(folder)
    (folder / "lock").write_bytes(lock._signed({**lock._identity(), "started": 1.0}))
    (folder / ".cell.host-1.tmp").mkdir()
    lock.tidy(folder)
    assert files_in(folder) == whole and not (folder / ".cell.host-1.tmp").exists()
    with lock.locked(folder):
        lock.tidy(folder)
        assert files_in(folder) == sorted([*whole, "lock"])

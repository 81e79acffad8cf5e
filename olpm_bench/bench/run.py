"""An experiment: all its cells, resumable, methods interleaved; then its table and figures."""
from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi

import representations
from olpm_bench import shipped
from olpm_bench.bench import environment
from olpm_bench.bench.cell import CellFailedError, WarmUp, load_scene, measure, spp_of_pass, warm_up
from olpm_bench.bench.clock import MAX_WAITED, UNRELIABLE
from olpm_bench.bench.config import CellSpec, Experiment, Scene
from olpm_bench.bench.files import NewerSchemaError, ResultError, require_inside
from olpm_bench.bench.lock import LockedError, locked, remove_unfinished, tidy
from olpm_bench.bench.progress import Bar, is_interrupt, reason
from olpm_bench.bench.reference_file import Reference, find_reference, read_reference
from olpm_bench.bench.results import DRAWN, Cell, Results, warnings
from olpm_bench.bench.shard import WHOLE, Shard
from olpm_bench.transport import camera_paths, headroom
from olpm_bench.transport.settings import InputError

if TYPE_CHECKING:
    from olpm_bench.bench.finished import Finished

LARGER = 8                  # references are averaged down by whole factors up to this
PATIENCE = 2.0              # [s] between looks at what is in other hands
# Bytes that a hit of a particle takes, at most: as `particles.trace` keeps it, and in all arrays while a gather brings it to the
# records.  The window of expected contributions may split particles until the room for hits is full, twice those of their paths.
STORED, SPLIT = 52, 2
GATHERED = {"binned": 50, "nearest": 130}


def references(experiment: Experiment, root: Path, without: Collection[str] = ()) -> dict[str, Reference]:
    """Scene name -> reference, of every scene that does not do without.

    Args:
        root: the `--results` folder.
        without: names of scenes to leave out.

    Raises:
        ResultError: one is missing or broken; the message names the command that makes it.
    """
    found = {}
    for scene in (scene for scene in experiment.scene if scene.has_reference and scene.name not in without):
        path = scene.reference or reference_of(experiment, scene, root)
        if path is None:
            raise ResultError(f"scene {scene.name} has no reference {experiment.reference_key(scene)}; make it with: "
                              f"{experiment.command('reference', root)}, or do without: reference = \"none\"; "
                              "run --with-reference makes it, too")
        found[scene.name] = read_reference(path, scene.width, scene.height)
    return found


def reference_of(experiment: Experiment, scene: Scene, root: Path) -> Path | None:
    """The scene's own reference of this size, or of a multiple of it: that of the full scale serves a small one."""
    for factor in range(1, LARGER + 1):
        larger = scene.model_copy(update={"width": factor * scene.width, "height": factor * scene.height})
        if found := find_reference(experiment.reference_key(larger), reference_folders(experiment, root)):
            return found
    return None


def reference_folders(experiment: Experiment, root: Path) -> list[Path]:
    """Where references are looked for, in this order."""
    return [root / "references", experiment.path.parent / ".." / "results" / "references", Path("results") / "references",
            shipped.folder("references")]


def run(experiment: Experiment, root: Path, only: Sequence[str] = (), shard: Shard = WHOLE, together: bool = False) -> list[str]:
    """Run what is not complete of an experiment; return one line for each cell that is not complete afterwards.

    Args:
        only: scenes to run; all by default.
        shard: the share of the cells to run.
        together: then run what the other shards have left, and wait for what is in other hands, so that all is complete
            in the end, whoever is killed meanwhile.

    Raises:
        ConfigError: no such scene.
        ResultError: a reference is missing, or links lead out of the results folder (nothing was run), or a result is of a
            newer schema.
        InputError: a cell needs more memory than there is (nothing was run).
        SceneError, OSError: a scene cannot be used; a file cannot be written.
    """
    results, part = Results(root / experiment.stem), experiment.of_scenes(only)
    references(part, root)                                  # before hours of work, not after
    cells = shard.first(part.cells()) if together else shard.of(part.cells())
    require_folders(results, cells, root)
    todo, problems = [], []
    for spec in cells:
        complete, why = is_complete(results, spec)
        if complete:
            tidy(results.cell_folder(spec.scene.name, spec.method.name, spec.seed))
        else:
            todo.append((spec, why))
    require_memory([spec for spec, _ in todo])
    loaded = {name: load_scene(spec) for name, spec in {spec.scene.name: spec for spec, _ in todo}.items()}
    remove_unfinished(results.folder)
    results.write_text("experiment.toml", experiment.toml(results.folder))
    if todo or not results.has_environment():       # else it is that of where the cells were made
        results.write_json("env.json", environment.describe())

    warm: dict[tuple[str, str], WarmUp] = {}
    failures = {str(spec): results.failure(spec.scene.name, spec.method.name, spec.seed) for spec, _ in todo}
    queue, held = deque(enumerate(todo)), 0
    with Bar(len(todo)) as bar:
        if len(todo) < len(cells):
            bar.say(f"{len(cells) - len(todo)} of {len(cells)} cells are complete already")
        while queue:
            index, (spec, why) = queue.popleft()
            if why:
                bar.say(f"{spec}: {why}; redone")
            try:
                cell = _run_cell(results, spec, loaded[spec.scene.name], warm, bar, index, failures[str(spec)])
                held = 0
            except (CellFailedError, LockedError) as error:
                if together and isinstance(error, LockedError):
                    queue.append((index, (spec, "")))
                    held += 1
                    if held >= len(queue):          # all that is left is in other hands
                        bar.at(len(todo) - len(queue), f"waiting for {spec}: {error}")
                        time.sleep(PATIENCE)
                        held = 0
                    continue
                problems.append(f"{spec}: {error}")
                bar.say(problems[-1])
                continue
            if cell is not None:
                info = cell.info
                flag = f", waited {info['wait_fraction']:.0%} for busy cores" if info["wait_fraction"] > MAX_WAITED else ""
                flag += "".join(f"; {warning}" for warning in warnings([cell.info]))
                bar.say(f"[{index + 1}/{len(todo)}] {spec}: {info['spp']} spp in {info['charged_seconds']:.1f} s, "
                        f"{info['train_seconds']:.1f} s of it training{flag}")
    return problems


def require_folders(results: Results, cells: Sequence[CellSpec], root: Path) -> None:
    """
    Raises:
        ResultError: links lead out of the results folder.
    """
    for folder in (results.folder, *(results.cell_folder(c.scene.name, c.method.name, c.seed) for c in cells)):
        require_inside(folder, root)


def is_complete(results: Results, spec: CellSpec) -> tuple[bool, str]:
    """Whether a cell need not be run; if it must be redone, why (empty: it never was complete).

    Raises:
        NewerSchemaError: written by a later version.
    """
    try:
        cell = results.verified_cell(spec.scene.name, spec.method.name, spec.seed, (spec.scene.height, spec.scene.width))
    except NewerSchemaError:
        raise
    except ResultError as error:
        return False, str(error)
    if cell is None:
        return False, ""
    return (True, "") if cell.info.get("key") == spec.key else (False, "made with other settings")


def _run_cell(results: Results, spec: CellSpec, scene: mi.Scene, warm: dict[tuple[str, str], WarmUp], bar: Bar,
              index: int, failure: tuple[int, str] | None) -> Cell | None:
    """Run a cell; None if another process has done so meanwhile.

    Args:
        failure: what was known of a failure of it before; another process's since then counts.
    """
    names = spec.scene.name, spec.method.name, spec.seed
    with locked(results.cell_folder(*names)) as alive:
        if is_complete(results, spec)[0]:
            return None
        if (now := results.failure(*names)) is not None and now != failure:
            raise CellFailedError(now[1])

        def on_progress(share: float, what: str) -> None:
            alive()
            bar.at(index + share, f"{spec}: {what}")
        try:
            pair = names[:2]
            if pair not in warm:
                bar.at(index, f"{spec}: compiling")
                warm[pair] = warm_up(spec, scene)
            done = measure(spec, scene, warm[pair], on_progress=on_progress)
            waited = done.info["wait_fraction"]
            if spec.budget.seconds is not None and waited > UNRELIABLE:     # else images don't depend on time
                bar.say(f"{spec}: other programs kept it from the processor for {waited:.0%} of the time; "
                        "measured once more")
                again = measure(spec, scene, warm[pair], on_progress=on_progress)
                done = min(done, again, key=lambda one: one.info["wait_fraction"])
        except (LockedError, NewerSchemaError):
            raise
        except Exception as error:              # the other cells may still work
            if is_interrupt(error):
                raise KeyboardInterrupt from error
            if (why := _why(spec, error)) is None:
                raise
            results.write_failure(*names, why)
            raise CellFailedError(why) from error
        info = {**done.info, "machine": environment.machine()}
        return results.write_cell(*names, info, done.trace, done.image, done.checkpoints, spec.config(), alive)


def _why(spec: CellSpec, error: Exception) -> str | None:
    """Why a cell has failed, if it is for its input, for Mitsuba, for want of memory, or for other people's code that it runs;
    else None: the others would fail, too."""
    if isinstance(error, CellFailedError | InputError):         # e.g. too little memory
        return str(error)
    if isinstance(error, RuntimeError | MemoryError):
        return reason(error)
    if representations.file_of(spec.method.representation_name or "") is not None:
        return f"{type(error).__name__}: {reason(error)}"
    return None


def memory(spec: CellSpec) -> float:
    """Memory that a cell takes, at most [GB]: Mitsuba itself, paths in flight, particles and vertices of a pass, images."""
    pixels = spec.scene.width * spec.scene.height
    lanes = pixels * (spp_of_pass(spec) if spec.budget.spp is not None else 16)
    particles, vertices = 0, 0
    if (training := spec.training) is not None:
        rows, single = camera_paths.rows_of(spec.integrator.max_depth), training.schedule == "single_batch"
        passes, importons = (training.passes, 0) if single else (min(training.passes, 1), training.importons)
        hits = passes * (training.photons + importons) * max(rows - 1, 1)
        if training.weight_window == "contribution" and not single:
            hits *= SPLIT
        particles = hits * (STORED + GATHERED[training.gather])
        if training.camera_passes or training.while_rendering:
            vertices = rows * min(max(training.camera_paths, pixels), camera_paths.MOST_PATHS)
    return (300e6 + 120 * lanes + particles + camera_paths.BYTES * vertices
            + pixels * 3 * (8 * 4 + 4 * spec.budget.checkpoints)) / 1e9


def require_memory(cells: Sequence[CellSpec]) -> None:
    """
    Raises:
        InputError: the one that needs most needs more than there is.
    """
    if not cells:
        return
    needed, largest = max(((memory(spec), spec) for spec in cells), key=lambda found: found[0])
    headroom.require(1e9 * needed, f"the paths, particles and images of {largest}",
                     "a smaller image, fewer photons, importons or checkpoints")


def report(experiment: Experiment, root: Path, only: Sequence[str] = ()) -> None:
    """Summary, table and figures of a complete experiment; the table is printed.

    Args:
        only: scenes that must be complete; while others are not, their table is all there is, and what is missing is said.

    Raises:
        ResultError: a cell or a reference is missing.
    """
    from olpm_bench.bench import finished, summary

    results = Results(root / experiment.stem)
    missing = Counter(spec.scene.name for spec in experiment.cells() if not is_complete(results, spec)[0]) if only else Counter()
    if missing:
        experiment = experiment.of_scenes(only)
    found = finished.read(experiment, results, references(experiment, root))
    summarised = summary.summarise(found)
    summary.print_table(summarised)
    if len(found.machines) > 1:
        print(f"made on different machines, whose seconds do not compare: {'; '.join(found.machines)}")
    if len(experiment.method) > 1:
        summary.print_speed_ups(found.speed_ups, experiment.baseline_name)
    if missing:
        cells = ", ".join(f"{n} of {scene}" for scene, n in missing.items())
        print(f"no summary and no figures yet; cells missing: {cells}")
        return
    summary.write(summarised, results)
    print(f"in {results.folder}: {', '.join(['summary.json', 'table.csv', *_draw(found, summarised['rows'])])}")


def _draw(found: Finished, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Draw all figures and the page that there are of an experiment, and remove those of an earlier run that are no more.

    Args:
        rows: of its summary.

    Returns:
        The names of the files.
    """
    from olpm_bench.report import crops, figures, page, sheet, sweeps

    blocks = sheet.blocks(found)
    written = figures.gains(found, rows) + sweeps.sweeps(found) + figures.curves(found) + sheet.sheet(found, blocks)
    if not blocks:
        print("no figure of L1 and no sheet: no scene has a reference")
    try:
        written += page.page(found, rows, blocks, [name for name in page.CAPTIONS if f"{name}.svg" in written])
        written += crops.crops(found, blocks)
    except ModuleNotFoundError as error:
        print(f"report.html and crops.pdf need {error.name}: pip install 'olpm-bench[report]'")
    for name in set(DRAWN).difference(written):
        (found.results.folder / name).unlink(missing_ok=True)
    return written

"""The command line.  Sets the variant and turns expected errors into one line and an exit code; nothing else.

Exit codes: 0 all is complete; 1 a cell failed or is missing; 2 bad input; 130 interrupted.
"""
from __future__ import annotations

import contextlib
import functools
import json
import signal
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from olpm_bench import __version__, shipped
from olpm_bench.bench.terminal import one_line
from olpm_bench.examples import epilog
from olpm_bench.transport.settings import InputError
from representations import RepresentationError
from representations._llvm import LLVMError

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
ENDING = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]      # as Ctrl-C
RESUMED = ("run", "submit", "gate", "reference")
MAX_SEED = 2**15 - 1        # of cells: `config.MAX_SEED`, whose import would take a second of every --help

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
                  epilog=epilog())

ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT", show_default=False,
                                                help="A TOML, or the name of an experiment that comes with olpm-bench.")]
ResultsFolder = Annotated[Path, typer.Option(
    "--results", metavar="DIR", help="Results go to DIR/<stem of the TOML>, references to DIR/references.")]
Replacements = Annotated[list[str], typer.Option(
    "--scene", metavar="NAME=PATH", help="Read the scene NAME of the experiment from another XML.")]
Scale = Annotated[str | None, typer.Option(
    "--scale", metavar="NAME", help="Run it at another of its scales, [scale.NAME] of the file; results in DIR/<stem>-NAME.")]
Only = Annotated[list[str], typer.Option("--only-scene", metavar="NAME", help="Leave the other scenes for later.")]
Assignments = Annotated[list[str], typer.Option(
    "--set", metavar="TABLE.KEY=VALUE", help="Change a setting; keys as in the TOML.")]


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"olpm-bench {__version__}")
        raise typer.Exit


@app.callback()
def options(version: Annotated[bool, typer.Option("--version", is_eager=True, callback=_show_version,
                                                  help="Show the version, and exit.")] = False) -> None:
    """Which learnt directional distribution guides a path tracer best?"""


def complain(message: str) -> None:
    """One line on stderr."""
    print(f"olpm-bench: {one_line(' '.join(message.split()))}", file=sys.stderr)


def command(body: Callable[..., None]) -> Callable[..., None]:
    """A command of `app` whose expected errors become one line on stderr and an exit code.

    Expected: what the user's files, options and machine can cause.  Anything else is a bug and keeps its traceback.
    """
    @functools.wraps(body)
    def run(*args: Any, **kwargs: Any) -> None:
        previous = {number: signal.signal(number, _interrupt) for number in ENDING
                    if signal.getsignal(number) is signal.SIG_DFL}      # nohup ignores one
        shown, warnings.showwarning = warnings.showwarning, _warn
        try:
            body(*args, **kwargs)
        except (typer.Exit, typer.Abort):
            raise
        except (KeyboardInterrupt, RuntimeError) as error:
            from olpm_bench.bench.progress import is_interrupt, reason
            if is_interrupt(error):
                resumed = body.__name__ in RESUMED or kwargs.get("log")
                complain("interrupted; " + ("what is complete is kept, and the same command goes on from there"
                                            if resumed else "the same command starts again"))
                raise typer.Exit(INTERRUPTED) from None
            if isinstance(error, NotImplementedError | RecursionError):
                raise
            complain(reason(error))         # of Mitsuba or Dr.Jit, or an image that cannot be used
            raise typer.Exit(FAILED) from None
        except SystemExit as error:
            if error.code:
                raise
            complain("code that is not ours has ended the process, as if all were well")
            raise typer.Exit(FAILED) from None
        except OSError as error:
            complain(": ".join(str(p) for p in (error.filename, error.strerror or error) if p))
            raise typer.Exit(BAD_INPUT) from None
        except (InputError, RepresentationError, LLVMError) as error:
            complain(str(error))
            raise typer.Exit(BAD_INPUT) from None
        finally:
            warnings.showwarning = shown
            for number, handler in previous.items():
                signal.signal(number, handler)
    name = body.__name__.strip("_")
    return app.command(name, epilog=epilog(name))(run)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """A Python warning as one line."""
    complain(str(message))


def _interrupt(signum: int, frame: object) -> None:
    raise KeyboardInterrupt


def _named_file(text: str, option: str) -> tuple[str, Path]:
    name, equals, file = text.partition("=")
    if not equals or not name or not file:
        raise InputError(f"{option} {text}: must be NAME=PATH")
    return name, Path(file)


def _replacements(texts: list[str] | None) -> dict[str, Path]:
    """`--scene NAME=PATH` options as a dictionary."""
    return dict(_named_file(text, "--scene") for text in texts or [])


def _load(path: Path, replacements: list[str] | None = None, scale: str | None = None) -> Any:
    """The experiment, at a scale of its own if one is named, with `NAME=PATH` options applied."""
    from olpm_bench.bench import experiment_file

    path, scenes = shipped.experiment_file(path), _replacements(replacements)
    if path.is_file() and ".py:" in path.read_text(encoding="utf-8", errors="replace"):
        from olpm_bench.bench import environment

        environment.select_variant()            # other people's file may name Mitsuba's types when it is imported
    return experiment_file.load(path, scenes, scale)


def _load_run(source: Path, results: Path, replacements: list[str] | None, scale: str | None) -> tuple[Any, Path]:
    """An experiment and the folder of its results, of which either is named: the TOML, or the folder, which has a copy of it."""
    if not source.is_dir():
        loaded = _load(source, replacements, scale)
        return loaded, results / loaded.stem
    if not (source / "experiment.toml").is_file():
        raise InputError(f"{source} is no folder of results: it has no experiment.toml")
    folder = source.resolve()
    return _load(folder / "experiment.toml", replacements, scale).of_results(folder), folder


@command
def run(experiment: ExperimentFile, results: ResultsFolder = Path("results"), scene: Replacements = [],  # noqa: B006
        only: Only = [],  # noqa: B006
        scale: Scale = None,
        dry_run: Annotated[bool, typer.Option("--dry-run", help="Print cells, hours, memory, and what would be refused; run "
                                                                "nothing.")] = False,
        with_reference: Annotated[bool, typer.Option("--with-reference", help="First make the references that are missing.")]
        = False,
        shard: Annotated[str, typer.Option(metavar="I/N", help="Run a part of the cells, and leave the others to other machines "
                                                               "that share the folder: 1/N to N/N.")] = "1/1",
        ) -> None:
    """Run an experiment, or what is missing of it; then print its table and draw its figures."""
    from olpm_bench.bench import environment

    loaded = _load(experiment, scene, scale)
    environment.select_variant()
    from olpm_bench.bench import plan as planning
    from olpm_bench.bench import reference as references
    from olpm_bench.bench import run as runner
    from olpm_bench.bench.shard import WHOLE, Shard

    part = Shard.parse(shard)
    if dry_run:
        found = planning.plan(loaded.of_scenes(only), results, part, with_reference)
        for line in planning.lines(found):
            print(line)
        for refusal in found.refusals:
            complain(refusal)
        raise typer.Exit(BAD_INPUT if found.refusals else 0)
    if with_reference:
        references.make(loaded.of_scenes(only), results)
    problems = runner.run(loaded, results, only, part)
    if problems:
        for problem in problems:
            complain(problem)
        cells = part.of(loaded.of_scenes(only).cells())
        complain(f"{len(problems)} of {len(cells)} cells are not complete; no table and no figures")
        raise typer.Exit(FAILED)
    if part != WHOLE and (left := planning.plan(loaded.of_scenes(only), results).todo):
        print(f"shard {part} is complete; no table and no figures yet: {len(left)} cells of other shards are missing")
        return
    runner.report(loaded, results, only)


@command
def submit(experiment: ExperimentFile, results: ResultsFolder = Path("results"), scene: Replacements = [],  # noqa: B006
           scale: Scale = None,
           workers: Annotated[int, typer.Option(min=1, help="Machines (slurm), or processes (local).")] = 1,
           cluster: Annotated[str, typer.Option(metavar="slurm|local", help="A Slurm cluster, or this machine.")] = "slurm",
           minutes: Annotated[int, typer.Option(min=1, help="Longest that a worker runs.")] = 1440,
           partition: Annotated[str | None, typer.Option(help="Of Slurm.", show_default=False)] = None,
           account: Annotated[str | None, typer.Option(help="Of Slurm.", show_default=False)] = None,
           constraint: Annotated[str | None, typer.Option(help="Of Slurm: the feature that names one CPU model.",
                                                          show_default=False)] = None) -> None:
    """Run an experiment by workers that share its folder, on the nodes of a cluster or on this machine."""
    from olpm_bench.bench import environment

    loaded = _load(experiment, scene, scale)
    environment.select_variant()
    try:
        from olpm_bench.bench import submit as submission
    except ModuleNotFoundError as error:
        raise InputError(f"submit needs {error.name}: pip install 'olpm-bench[cluster]'") from None
    from olpm_bench.bench import plan as planning
    from olpm_bench.bench import run as runner
    from olpm_bench.bench.results import Results

    runner.references(loaded, results)          # before the cluster is asked
    jobs = submission.submit(loaded, results, cluster, workers, minutes, _replacements(scene), scale,
                             partition=partition, account=account, constraint=constraint)
    if cluster == "slurm":
        print(f"submitted: {', '.join(job.job_id for job in jobs)}; once they have ended, this draws the figures: "
              f"{loaded.command('run', results)}")
        return
    submission.wait(jobs, loaded, results)
    if left := planning.plan(loaded, results).todo:
        stored = Results(results / loaded.stem)
        for spec in left:
            failure = stored.failure(spec.scene.name, spec.method.name, spec.seed)
            complain(f"{spec}: {failure[1]}" if failure else f"{spec} is not complete")
        complain(f"{len(left)} of {len(loaded.cells())} cells are not complete; no table and no figures; "
                 f"logs are in {results / loaded.stem / 'jobs'}")
        raise typer.Exit(FAILED)
    runner.report(loaded, results)


@command
def report(source: Annotated[Path, typer.Argument(metavar="RESULTS|EXPERIMENT.toml", show_default=False,
                                                  help="A folder of results, or the experiment that they are of.")],
           results: ResultsFolder = Path("results"), scene: Replacements = [], scale: Scale = None) -> None:  # noqa: B006
    """Print the table and draw the figures and the page of a complete experiment again."""
    from olpm_bench.bench import environment

    loaded, folder = _load_run(source, results, scene, scale)
    environment.select_variant()
    from olpm_bench.bench import run as runner

    runner.report(loaded, folder.parent)


@command
def gate(experiment: ExperimentFile, results: ResultsFolder = Path("results"), scene: Replacements = [],  # noqa: B006
         scale: Scale = None) -> None:
    """Put an experiment's claims to the test, after running what is missing; exit code 1 if one fails."""
    from olpm_bench.bench import environment

    loaded = _load(experiment, scene, scale)
    environment.select_variant()
    from olpm_bench.bench import gate as gates
    from olpm_bench.bench import run as runner
    from olpm_bench.bench.results import Results

    gates.check(loaded)
    if problems := runner.run(loaded, results):
        for problem in problems:
            complain(problem)
        complain(f"{len(problems)} of {len(loaded.cells())} cells are not complete; no verdict")
        raise typer.Exit(FAILED)
    folder = Results(results / loaded.stem)
    verdicts = gates.judge(loaded, folder, runner.references(loaded, results))
    gates.write(verdicts, folder)
    gates.print_verdicts(verdicts)
    if not all(verdict.holds for verdict in verdicts):
        raise typer.Exit(FAILED)


@command
def reference(experiment: ExperimentFile, results: ResultsFolder = Path("results"), scene: Replacements = [],  # noqa: B006
              scale: Scale = None,
              seconds: Annotated[float | None, typer.Option(
                  min=1.0, help="Charged seconds for each scene; by default 300, or 25 times a cell's budget if that is more.",
                  show_default=False)] = None) -> None:
    """Make or improve the references of an experiment: two unguided halves, resumable."""
    from olpm_bench.bench import environment

    loaded = _load(experiment, scene, scale)
    environment.select_variant()
    from olpm_bench.bench import reference as references

    if not references.improve(loaded, results, seconds or references.seconds_for(loaded)):
        print(f"nothing to make: each scene of {experiment.name} names its reference or does without")


@command
def metrics(source: Annotated[Path, typer.Argument(metavar="RESULTS|EXPERIMENT.toml", show_default=False,
                                                   help="A folder of results, or the experiment that they are of.")],
            results: ResultsFolder = Path("results"), scene: Replacements = [],  # noqa: B006
            scale: Scale = None) -> None:
    """Compute every metric anew from the images of an experiment; nothing is rendered."""
    from olpm_bench.bench import environment

    loaded, folder = _load_run(source, results, scene, scale)
    environment.select_variant()
    from olpm_bench.bench import finished, summary
    from olpm_bench.bench import run as runner
    from olpm_bench.bench.results import Results

    stored = Results(folder)
    references = runner.references(loaded, folder.parent)
    found = summary.summarise(finished.read(loaded, stored, references, any_version=True))
    summary.write(found, stored)
    summary.print_metrics(found)
    if outdated := sum(not runner.is_complete(stored, spec)[0] for spec in loaded.cells()):
        print(f"{outdated} of {len(loaded.cells())} cells were made by other code, or of another file of the scene")
    print(f"in {folder}: summary.json, table.csv")


@command
def compare(a: Annotated[Path, typer.Argument(metavar="A.exr", show_default=False)],
            b: Annotated[Path, typer.Argument(metavar="B.exr", show_default=False)],
            reference: Annotated[Path | None, typer.Option(
                metavar="R.exr", help="Or a folder of references; B by default.", show_default=False)] = None,
            as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False) -> None:
    """Compare two images with a reference, or with each other, by every metric."""
    from olpm_bench.bench import compare as comparing
    from olpm_bench.bench.files import plain

    found = comparing.compare(a, b, reference)
    if as_json:
        print(json.dumps(plain(found.as_dict()), allow_nan=False))
    else:
        comparing.print_comparison(found)


@command
def render(scene: Annotated[str, typer.Argument(metavar="SCENE", help="An embedded scene, or a Mitsuba XML.",
                                                show_default=False)],
           method: Annotated[str, typer.Option(metavar="unguided|REPRESENTATION", show_default=False)],
           out: Annotated[Path, typer.Option(metavar="FILE.exr", show_default=False)],
           set_: Assignments = [],  # noqa: B006
           seconds: Annotated[float | None, typer.Option(help="Charged seconds, training included.")] = None,
           spp: Annotated[int | None, typer.Option(help="Samples per pixel; repeats bit for bit.  That of the file by "
                                                   "default.")] = None,
           width: Annotated[int | None, typer.Option(help="Of the image [pixels]; that of the file by default, 320 of an "
                                                     "embedded scene.", show_default=False)] = None,
           height: Annotated[int | None, typer.Option(help="By default as the width and the scene's aspect say.",
                                                      show_default=False)] = None,
           max_depth: Annotated[int | None, typer.Option(help="Longest path in segments, -1 for no limit; that of the file by "
                                                         "default, 13 of an embedded scene.", show_default=False)] = None,
           seed: int = 0,
           threads: Annotated[int | None, typer.Option(help="Threads; all cores by default.")] = None,
           save_guide: Annotated[Path | None, typer.Option(metavar="FILE.npz", show_default=False)] = None,
           load_guide: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Use this guide; train none.",
                                                           show_default=False)] = None,
           records_map: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the guide's records over the image.",
                                                            show_default=False)] = None,
           json_: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False) -> None:
    """Render one image, and say in three lines what it is, where it is, and how long it took."""
    from olpm_bench.bench import environment

    if save_guide is not None and load_guide is not None:
        raise InputError("give either --save-guide or --load-guide")
    environment.select_variant(threads)
    from olpm_bench.bench import render_one
    from olpm_bench.bench.files import plain
    from olpm_bench.bench.results import warnings as warnings_of

    spec = render_one.cell(scene, method, set_, seconds=seconds, spp=spp, width=width, height=height,
                           max_depth=max_depth, seed=seed, load_guide=load_guide)
    done = render_one.render(spec, out, save_guide=save_guide, load_guide=load_guide, records_map=records_map)
    for warning in warnings_of([done]):
        print(f"olpm-bench: {warning}", file=sys.stderr)
    if json_:
        print(json.dumps(plain(done), allow_nan=False))
    else:
        for line in render_one.summary(done):
            print(one_line(line))


@command
def inspect(run: Annotated[Path, typer.Argument(metavar="RUN", help="An experiment's TOML, or its results folder.",
                                                show_default=False)],
            pixel: Annotated[list[str], typer.Option(metavar="X,Y", help="From the top left; can be given again.",
                                                     show_default=False)],
            scene: Annotated[list[str], typer.Option(metavar="NAME[=PATH]", help="Which scene, and where its file is; after the "
                                                     "first, where those of others are.", show_default=False)] = [],  # noqa: B006
            method: Annotated[list[str], typer.Option(metavar="NAME", help="Which methods; by default all, or of a sweep the "
                                                      "last where they are many.", show_default=False)] = [],  # noqa: B006
            seed: Annotated[int | None, typer.Option(min=0, max=MAX_SEED, show_default=False, help="Of the training; the "
                                                     "experiment's first by default.")] = None,
            vertex: Annotated[int | None, typer.Option(min=1, help="Of a path from that pixel; the first that is not specular by "
                                                       "default.", show_default=False)] = None,
            path_seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Of that path.")] = 0,
            guide: Annotated[list[str], typer.Option(metavar="METHOD=FILE.npz", help="Use this guide; train none.")] = [],  # noqa: B006
            passes: Annotated[int, typer.Option(min=2, help="Of the truth, 64 paths a bin each.")] = 16,
            results: ResultsFolder = Path("results"), scale: Scale = None) -> None:
    """Show what guides have learnt where a pixel looks: their densities, particles and records beside the truth."""
    from olpm_bench.bench import environment

    name = scene[0].partition("=")[0] if scene else None
    pixels, guides = [_pixel(text) for text in pixel], dict(_named_file(text, "--guide") for text in guide)
    loaded, folder = _load_run(run, results, [s for s in scene if "=" in s], scale)
    environment.select_variant()
    from olpm_bench.bench import inspect as inspector

    written = inspector.inspect(loaded, folder, pixels, scene=name, methods=method, seed=seed, number=vertex,
                                path_seed=path_seed, passes=passes, guides=guides)
    for path in written:
        print(path)


def _pixel(text: str) -> tuple[int, int]:
    try:
        x, y = map(int, text.split(","))
        return x, y
    except ValueError:
        raise InputError(f"--pixel {text}: must be X,Y, two whole numbers") from None


@command
def fit(representation: Annotated[str, typer.Option(metavar="NAME", show_default=False)],
        samples: Annotated[Path, typer.Option(metavar="S.npz", show_default=False)],
        heldout: Annotated[Path, typer.Option(metavar="H.npz", show_default=False)],
        set_: Assignments = [],  # noqa: B006
        batches: Annotated[int, typer.Option(min=1)] = 1, seed: int = 0) -> None:
    """Train a representation on directional data; prints one JSON object."""
    from olpm_bench.bench import environment

    environment.select_variant()
    import representations
    from olpm_bench.bench import experiment_file
    from olpm_bench.bench import fit as fitting
    from olpm_bench.bench.files import plain
    from olpm_bench.bench.render_one import settings

    experiment_file.announce(representation)
    created = representations.create(representation, **settings(set_, ("representation",))["representation"])
    print(json.dumps(plain(fitting.fit(created, samples, heldout, batches, seed)), allow_nan=False))


@command
def check(representation: Annotated[str, typer.Argument(metavar="NAME|FILE.py:CLASS", show_default=False)],
          set_: Assignments = [],  # noqa: B006
          declare: Annotated[list[str], typer.Option(metavar="constant|grows|coarse", help="On purpose, it learns nothing, keeps "
                                                     "all particles, or keeps too little to fit several lobes.")] = [],  # noqa: B006
          only: Annotated[list[str], typer.Option(metavar="CHECK", help="Leave out all other checks.")] = [],  # noqa: B006
          seed: Annotated[int, typer.Option(min=0, max=1 << 24)] = 0,
          repeat: Annotated[int, typer.Option(min=1, help="Run with so many seeds, and count the false alarms.")] = 1,
          log: Annotated[Path | None, typer.Option(metavar="FILE", help="Each run adds a line of JSON; seeds that it has are not "
                                                   "run again, and count.")] = None,
          pictures: Annotated[Path, typer.Option(metavar="DIR", help="Where pictures of failures go.")] = Path("results/check"),
          json_: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False) -> None:
    """Examine a representation, ours or yours: is it the distribution that it says it is, does it learn, guide unbiased?"""
    from olpm_bench.bench import environment

    environment.select_variant()
    from olpm_bench.bench import experiment_file
    from olpm_bench.bench.files import plain
    from olpm_bench.bench.render_one import settings
    from olpm_bench.check import examination, suite

    experiment_file.announce(representation)
    specification = {"type": representation, **settings(set_, ("representation",))["representation"]}
    checks, subject = suite.named(only), suite.Subject(specification, seed, declare)
    with contextlib.redirect_stdout(sys.stderr) if json_ else contextlib.nullcontext():         # what its own code may print
        if repeat > 1 or log:
            found = examination.campaign(subject, checks, repeat, pictures, quiet=json_, log=log)
        else:
            found = examination.examine(subject, checks, pictures, quiet=json_)
    if json_:
        print(json.dumps(plain(found), allow_nan=False))
    if not found["passed"]:
        raise typer.Exit(FAILED)


@command
def perf(scene: Annotated[str, typer.Option(metavar="NAME|FILE.xml", help="What is rendered and trained on.")] = "door_ajar",
         width: Annotated[int, typer.Option(min=1)] = 160, height: Annotated[int, typer.Option(min=1)] = 90,
         passes: Annotated[int, typer.Option(min=3, help="Training passes; timed from the third on.")] = 20) -> None:
    """Measure what the targets are about; prints one JSON object."""
    from olpm_bench.bench import environment

    environment.select_variant()
    from olpm_bench.bench import perf as performance
    from olpm_bench.bench.files import plain

    print(json.dumps(plain(performance.measure(scene, width, height, passes=passes)), allow_nan=False))


@command
def list_() -> None:
    """Show scenes, representations with their parameters (name, type, default), and experiments."""
    from olpm_bench.bench import listing

    for line in listing.lines():
        print(line)


@command
def new(kind: Annotated[str, typer.Argument(metavar="experiment|representation", show_default=False)],
        name: Annotated[str, typer.Argument(metavar="NAME", show_default=False)]) -> None:
    """Write NAME.toml or NAME.py: an experiment, or a representation, that runs as it is and explains itself."""
    from olpm_bench.bench import new as beginning

    path = beginning.new(kind, name)
    print(f"wrote {path}; next: {beginning.next_step(kind, path)}")


def main() -> None:
    app()


if __name__ == "__main__":
    main()

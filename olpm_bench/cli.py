"""The command line.  Sets the variant and turns expected errors into one line and an exit code; nothing else.

Exit codes: 0 all is complete; 1 a cell failed or is missing; 2 bad input; 130 interrupted.
"""
from __future__ import annotations

import contextlib
import functools
import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from olpm_bench.bench.terminal import one_line
from olpm_bench.transport.settings import InputError
from representations import RepresentationError
from representations._llvm import LLVMError

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
ENDING = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]      # as Ctrl-C
RESUMED = ("run", "submit", "gate", "reference")
MAX_SEED = 2**15 - 1        # of cells: `config.MAX_SEED`, whose import would take a second of every --help

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
                  help="Which learnt directional distribution guides a path tracer best?")

ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", show_default=False)]
ResultsFolder = Annotated[Path, typer.Option(
    "--results", metavar="DIR", help="Results go to DIR/<stem of the TOML>, references to DIR/references.")]
Replacements = Annotated[list[str], typer.Option(
    "--scene", metavar="NAME=PATH", help="Read the scene NAME of the experiment from another XML.")]
Scale = Annotated[str | None, typer.Option(
    "--scale", metavar="NAME", help="Run it at another of its scales, [scale.NAME] of the file; results in DIR/<stem>-NAME.")]
Only = Annotated[list[str], typer.Option("--only-scene", metavar="NAME", help="Leave the other scenes for later.")]
Assignments = Annotated[list[str], typer.Option(
    "--set", metavar="TABLE.KEY=VALUE", help="Change a setting; keys as in the TOML.")]


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
            for number, handler in previous.items():
                signal.signal(number, handler)
    return app.command(body.__name__.strip("_"))(run)


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

    scenes = _replacements(replacements)
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
        dry_run: Annotated[bool, typer.Option("--dry-run", help="Print cells, hours and memory; run nothing.")] = False,
        shard: Annotated[str, typer.Option(metavar="I/N", help="Run a part of the cells, and leave the others to other machines "
                                                               "that share the folder: 1/N to N/N.")] = "1/1",
        ) -> None:
    """Run an experiment, or what is missing of it; then print its table and draw its figures."""
    from olpm_bench.bench import environment

    loaded = _load(experiment, scene, scale)
    environment.select_variant()
    from olpm_bench.bench import run as runner
    from olpm_bench.bench.shard import WHOLE, Shard

    part = Shard.parse(shard)
    if dry_run:
        plan = runner.plan(loaded.of_scenes(only), results, part)
        hours = "unknown" if plan["hours"] is None else f"{plan['hours']:.2f}, and compilation"
        for spec in plan["cells"]:
            print(f"{spec}{'' if spec in plan['todo'] else '  (complete)'}")
        print(f"{len(plan['todo'])} of {len(plan['cells'])} cells to run; hours: {hours}; "
              f"memory: about {plan['gigabytes']:.1f} GB")
        return
    problems = runner.run(loaded, results, only, part)
    if problems:
        for problem in problems:
            complain(problem)
        cells = part.of(loaded.of_scenes(only).cells())
        complain(f"{len(problems)} of {len(cells)} cells are not complete; no table and no figures")
        raise typer.Exit(FAILED)
    if part != WHOLE and (left := runner.plan(loaded.of_scenes(only), results)["todo"]):
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
    if left := runner.plan(loaded, results)["todo"]:
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
              seconds: Annotated[float, typer.Option(min=1.0, help="Charged seconds for each scene.")] = 300.0) -> None:
    """Make or improve the references of an experiment: two unguided halves, resumable."""
    from olpm_bench.bench import environment

    loaded = _load(experiment, scene, scale)
    environment.select_variant()
    from olpm_bench.bench import reference as references

    if not references.improve(loaded, results, seconds):
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
           spp: Annotated[int | None, typer.Option(help="Samples per pixel; repeats bit for bit.")] = None,
           width: int = 320, height: int = 180, max_depth: int | None = None, seed: int = 0,
           threads: Annotated[int | None, typer.Option(help="Threads; all cores by default.")] = None,
           save_guide: Annotated[Path | None, typer.Option(metavar="FILE.npz", show_default=False)] = None,
           load_guide: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Use this guide; train none.",
                                                           show_default=False)] = None,
           records_map: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the guide's records over the image.",
                                                            show_default=False)] = None,
           ) -> None:
    """Render one image; the last line printed is one JSON object."""
    from olpm_bench.bench import environment

    if save_guide is not None and load_guide is not None:
        raise InputError("give either --save-guide or --load-guide")
    environment.select_variant(threads)
    from olpm_bench.bench import render_one
    from olpm_bench.bench.files import plain
    from olpm_bench.bench.results import warnings

    spec = render_one.cell(scene, method, set_, seconds=seconds, spp=spp, width=width, height=height,
                           max_depth=max_depth, seed=seed, load_guide=load_guide)
    done = render_one.render(spec, out, save_guide=save_guide, load_guide=load_guide, records_map=records_map)
    for warning in warnings([done]):
        print(f"olpm-bench: {warning}", file=sys.stderr)
    print(json.dumps(plain(done), allow_nan=False))


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
    """Show scenes, representations and experiments."""
    import tomllib

    import representations
    from olpm_bench import scenes

    print("Scenes")
    for name, description in scenes.names().items():
        given = ", ".join(f"{k} = {v}" for k, v in scenes.parameters(name).items())
        print(f"  {name}: {description}{f'  ({given})' if given else ''}")
    print("  or any Mitsuba XML\nRepresentations")
    for name in representations.names():
        print(f"  {name}")
    print("  or path/to/file.py:ClassName\nExperiments")
    files = sorted(Path("experiments").glob("*.toml"))
    for file in files:
        try:
            title = tomllib.loads(file.read_text(encoding="utf-8")).get("title", "")
        except (OSError, ValueError, RecursionError) as error:
            title = f"cannot be read: {error}"
        print(one_line(f"  {file}: {title}"))
    if not files:
        print("  none in ./experiments")


def main() -> None:
    app()


if __name__ == "__main__":
    main()

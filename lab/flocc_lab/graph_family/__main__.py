"""`python -m flocc_lab.graph_family`: methods on seeds of the family."""

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from flocc_lab.graph_family.family_campaign import run, table
from flocc_lab.graph_family.family_spec import Lengths, drawn
from flocc_lab.graph_family.graphs import KnownGraph, member
from flocc_lab.graph_family.methods import Method, flocc, methods, settings
from flocc_lab.graph_family.recording_variants import variant
from flocc_launch.graph_files import read_graph_file


def main() -> None:
    """Run the campaign that the command line names and print its table."""
    options = parsed(sys.argv[1:])
    chosen = chosen_methods(options.methods.split(",") if options.methods else [], options.set, options.earlier)
    seeds: Sequence[int] = range(options.first, options.first + options.draws)
    if options.recordings:
        files = [read_graph_file(path) for path in options.recordings]
        graph_of: Callable[[int], KnownGraph] = partial(variant, files=files)
    else:
        graph_of = member
        specs = [spec for spec in map(drawn, seeds) if sum(spec.keyframes) <= options.keyframes_max]
        seeds = [spec.seed for spec in specs if options.lengths in (None, spec.lengths.value)]
    verdicts = run(seeds, chosen, options.rows, options.limit_s, graph_of)
    sys.stdout.write(table([v for v in verdicts if v.method in chosen]) + "\n")


def parsed(words: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m flocc_lab.graph_family", description=__doc__)
    parser.add_argument("--draws", type=int, default=60, help="number of graphs")
    parser.add_argument("--first", type=int, default=1, help="seed of the first graph")
    parser.add_argument("--keyframes-max", type=int, default=10**9, help="leave out graphs with more keyframes")
    lengths = [kind.value for kind in Lengths]
    parser.add_argument("--lengths", choices=lengths, help="only graphs whose closures are known so far")
    parser.add_argument(
        "--recordings", type=Path, nargs="+", metavar="FILE", help="variants of labelled recordings (JRL) instead"
    )
    parser.add_argument("--methods", default="flocc", help="names with commas between them; empty: all")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="flocc so changed, too")
    parser.add_argument("--earlier", type=Path, help="another checkout, whose default runs beside")
    parser.add_argument("--rows", type=Path, help="file of JSON lines to add to and to go on from")
    parser.add_argument("--limit-s", type=float, default=900.0, help="no graph is begun after so long")
    return parser.parse_args(words)


def chosen_methods(names: list[str], changes: list[str], source: Path | None) -> dict[str, Method]:
    """The methods that were asked for."""
    known = methods(source)
    unknown = [name for name in names if name not in known]
    if unknown:
        sys.exit(f"no method {unknown[0]!r}; there are {', '.join(known)}")
    chosen = {name: known[name] for name in names or known}
    return chosen | {change: flocc(settings(**_changed(change))) for change in changes}


def _changed(change: str) -> dict[str, Any]:
    return dict(pair.split("=", 1) for pair in change.split(","))


if __name__ == "__main__":
    main()

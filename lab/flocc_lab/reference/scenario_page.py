"""The generated parts of docs/scenarios.md: `python -m flocc_lab.reference.scenario_page docs/scenarios.md`.

What stands between `<!-- keys -->`, `<!-- faults -->` or `<!-- shipped -->` and the next `<!-- end -->` is written from
the models and the shipped scenario files; everything else on the page is written by hand.
"""

from flocc_lab.reference.configuration_page import page_of, section, shared
from flocc_launch.scenarios.scenario import FaultKind, Scenario
from flocc_launch.scenarios.shipped import FOLDER, names

END = "<!-- end -->"
EXAMPLES = tuple(name for name in names() if name != "demo")


def filled(page: str) -> str:
    """A page with its generated parts written anew."""
    for mark, text in (("keys", keys()), ("shipped", shipped()), ("faults", faults())):
        before, found, rest = page.partition(f"<!-- {mark} -->\n")
        if found:
            page = f"{before}{found}{text}\n{END}{rest.partition(END)[2]}"
    return page


def keys() -> str:
    """Every key of a scenario that an agent's configuration does not have as well."""
    return "\n".join(section(Scenario, "", shared()))


def shipped() -> str:
    """Each shipped scenario: what its comment says, then the file."""
    return "\n".join(example(name) for name in EXAMPLES)


def example(name: str) -> str:
    """One shipped scenario."""
    lines = (FOLDER / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    said = " ".join(line.removeprefix("# ") for line in lines if line.startswith("#"))
    rest = "\n".join(line for line in lines if not line.startswith("#")).strip()
    return f"### `{name}`\n\n{said}\n\n```toml\n{rest}\n```\n"


def faults() -> str:
    """Names of all kinds of fault."""
    return ", ".join(f"`{kind.value}`" for kind in FaultKind) + "."


if __name__ == "__main__":
    path = page_of("flocc_lab.reference.scenario_page", "Write the generated parts of docs/scenarios.md anew.")
    path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")

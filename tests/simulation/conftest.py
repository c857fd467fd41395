"""`pytest tests/simulation --rewrite` writes into the traces what really happens; explain every line that changes."""

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rewrite", action="store_true", help="rewrite the traces of tests/simulation")

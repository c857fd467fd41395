"""Command line, scenarios, processes, virtual-time simulation, worlds, data sets, evaluation and reports."""

"""The paper's evaluation as commands: `flocc experiment NAME --out DIR`.

One module per experiment says what is measured and how it is summed up (`experiment.Experiment`); `runner` runs the
cells, keeps what is finished and writes tables and figures; `registry` names all experiments.
"""

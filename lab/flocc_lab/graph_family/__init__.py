"""A family of pose graphs with known answers, and how solvers do on it: what the back end's defaults are chosen on.

`python -m flocc_lab.graph_family --help` runs a campaign; `make campaign` runs the long one.
"""

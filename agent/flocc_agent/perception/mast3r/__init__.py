"""The paper's front end: CosPlace descriptors and MASt3R registration, split across two robots.

Written from a specification of the published networks; no reference code and no weights live here. Torch is an
optional extra (`pip install flocc[mast3r]`): nothing outside this package imports it at import time, and this
`__init__` does not either.
"""

"""Configuration of the running smart room: one file for a site, one for each node.

model.py         what may stand in them
passwords.py     the password of a camera stands elsewhere, and is put in when the camera is opened
load.py          reading, with all faults told at once
bus_options.py   how they say to reach the bus
examples.py      commented examples, which `spotcal init` writes

Paths in them are meant from the folder in which they stand.
"""

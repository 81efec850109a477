"""The bus: what travels between nodes, under which keys, how surely, and what is believed of what arrives.

`spotcal.proto` says what a message holds, `keys.py` where it goes, `qos.py` how urgently. `checks.py` is the one door
for what arrives: a message is either whole and within its bounds, or refused with the reason. `session.py` opens
sessions and routers; `node.py` is what every node does on the bus; `ledger.py` knows which rows are here. Facts about
the transport stand beside the code that they shaped.
"""

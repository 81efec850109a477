"""`spotcal devices`: what is on the serial ports."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console, Group
from rich.text import Text

from nodes.devices.instruments import FoundInstrument, identify, serial_ports
from nodes.report.tables import plain_table


def devices_view(addresses: Sequence[str], *, console: Console) -> Group:
    """Ask the addresses, or all serial ports, one after the other; `console` is told which."""
    ports = [(address, "") for address in addresses] or serial_ports()
    if not ports:
        return Group(
            Text(
                "No serial port on this machine. Plug an instrument in; those on the network are asked by address, as "
                "in: spotcal devices tcp://192.168.0.10:10940"
            )
        )
    found = []
    for address, port in ports:
        console.print(f"asking {address}", markup=False, soft_wrap=True)
        found.append(identify(address, port))
    return _table(found)


def _table(found: Sequence[FoundInstrument]) -> Group:
    table = plain_table("Instruments", "address")
    table.add_column("what")
    table.add_column("says", overflow="fold")
    for each in found:
        what = str(each.kind) if each.kind else f"none known ({each.port})" if each.port else "none known"
        table.add_row(Text(each.address), Text(what), Text(each.description))
    return Group(table)

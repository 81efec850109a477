"""What a scanner's status codes mean, in words for a person."""

from __future__ import annotations

STATUS_DATA, STATUS_OK = "99", "00"
LASER_FAULT, LASER_OFF = "01", "10"
SAME_SPEED = "03"

_SCAN = {
    "01": "the first step is no number",
    "02": "the last step is no number",
    "03": "the cluster is no number",
    "04": "the last step is beyond its field",
    "05": "the last step is before the first",
    "06": "the interval is no number",
    "07": "the number of scans is no number",
    LASER_OFF: "its laser is off",
}
_SPEED = {
    "01": "the speed is no number",
    "02": "it knows no such speed",
    SAME_SPEED: "it has this speed already",
    "04": "this model does not have this speed",
}
_TIME = {"01": "no such control code", "02": "it adjusts its time already", "03": "it does not adjust its time",
         "04": "it is not adjusting its time"}  # fmt: skip
_ANY = {
    "0A": "it cannot do this now",
    "0B": "it is busy with the command before",
    "0C": "the command's numbers are none of its own",
    "0D": "it does not know the command",
    "0E": "it does not know the command",
    "0F": "the command's numbers are none of its own",
    "0G": "the string is longer than 16 characters",
    "0H": "the string has a character that it does not take",
    "0I": "it is about to change its firmware",
    "0L": "it is in an abnormal state",
}


def status_words(command: str, status: str) -> str:
    """A status code that refuses a command, with what it means where that is known."""
    table = {"SS": _SPEED, "TM": _TIME, "BM": {LASER_FAULT: "the laser does not come on"}}.get(command[:2], _SCAN)
    words = table.get(status) or _ANY.get(status)
    code = int(status) if status.isascii() and status.isdigit() else 0
    if words is None and 21 <= code <= 49:
        words = "it stopped to look into an error"
    if words is None and 50 <= code <= 97:
        words = "hardware fault"
    return f"status {status}" + (f": {words}" if words else "")

"""Recordings: what was received, as it was received, in MCAP files that describe themselves.

While a session runs, `parts/part-0001.mcap` and so on hold one record after the other, unchunked and with the system at
once, so that a crash loses nothing; at the end they become `session.mcap`, compressed and indexed. `reader.rows` reads
either, whole or cut off anywhere; `session_data.read_session` makes columns of it.
"""

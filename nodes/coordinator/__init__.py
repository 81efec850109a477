"""The coordinator: everything that the nodes of a site observe, once each, and what is made of it.

ingest.py      from the bus: one worker behind Zenoh's threads; `complete` says what could not be had
intake.py      what is believed of what arrives: checks, boots, sequence
books.py       what one node's journal is known to hold, and when to ask it next
catch_up.py    asks for what is missing; asker.py sends the questions; missing.py is the report
refusals.py    what was refused, by whom and why
presence.py    who is there

run.py         the program: configuration, terminal, signals, exit status; plan.py, keyboard.py
coordinator.py wiring of one session
phases.py      its state, a pure function; facts.py what that rests on; session_message.py what the person is told
orders.py      what nodes are told, so that whoever comes back falls into step
session_store.py   what came in, recorded and counted; session_folder.py what survives the coordinator
coverage.py    what has been seen; sufficiency.py what is enough; guidance.py, room_cells.py where to wave next
progress.py    the costly looks, paced; live_solve.py a first calibration; worker_process.py where it runs
ending.py      stop, complete, close, solve; finishing.py what is written then
announcer.py   what is said on the bus; live_view.py, view_rows.py what is shown
"""

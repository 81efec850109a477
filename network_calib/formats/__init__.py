"""Files: every format that observations and calibrations are read from and written to. Nothing else touches a disk.

- `recording.py`, `source.py`: what a reader gives; the choice of reader by the look of the source.
- `svoboda.py`, `matrix_text.py`, `rad.py`, `svoboda_cfg.py`: MultiCamSelfCal recordings.
- `table.py`, `table_columns.py`: CSV and NPZ tables of spots.
- `calibration_json.py`, `calibration_reader.py`, `strict_json.py`: the result file.
- `svoboda_export.py`, `aniposelib.py`, `opencv.py`: results for other tools.
"""

"""Reading site.toml, camera.toml and lrf.toml. Paths in them are meant from the folder in which they stand."""

from __future__ import annotations

import re
from pathlib import Path

from nodes.config_file import config_of_text, read_config
from nodes.detector_settings import is_recording
from nodes.site.model import CameraNodeConfig, CameraSourceConfig, LrfNodeConfig, SiteConfig, TlsConfig

SIMULATED = "simulated:"


def load_site(path: Path) -> SiteConfig:
    """Read a site.toml.

    Raises:
        InputError: no TOML, or lists every fault with its path, for example `nodes[2].role`.
    """
    config, folder = read_config(path, SiteConfig), path.absolute().parent
    return config.model_copy(update={"data": str(folder / config.data), "tls": _tls(config.tls, folder)})


def site_of_text(text: str, *, name: str) -> SiteConfig:
    """A site.toml that stands in a recording, its paths as written; `name` says in messages where."""
    return config_of_text(text, SiteConfig, name=name)


def load_camera_node(path: Path) -> CameraNodeConfig:
    """Read a camera node's configuration. The same faults as of `load_site`."""
    config, folder = read_config(path, CameraNodeConfig), path.absolute().parent
    changes = {
        "journal": str(folder / config.journal),
        "tls": _tls(config.tls, folder),
        "cameras": [_camera(camera, folder) for camera in config.cameras],
    }
    return config.model_copy(update=changes)


def load_lrf_node(path: Path) -> LrfNodeConfig:
    """Read an LRF node's configuration. The same faults as of `load_site`."""
    config, folder = read_config(path, LrfNodeConfig), path.absolute().parent
    return config.model_copy(update={"journal": str(folder / config.journal), "tls": _tls(config.tls, folder)})


def _tls(tls: TlsConfig | None, folder: Path) -> TlsConfig | None:
    if tls is None:
        return None
    return TlsConfig(ca=str(folder / tls.ca), certificate=str(folder / tls.certificate), key=str(folder / tls.key))


def _camera(camera: CameraSourceConfig, folder: Path) -> CameraSourceConfig:
    mask = None if camera.mask is None else str(folder / camera.mask)
    return camera.model_copy(update={"mask": mask, "source": _source(camera.source, folder)})


def _source(text: str, folder: Path) -> str:
    """A source with its path from the folder; addresses and devices as they are."""
    if text.startswith(SIMULATED):
        return SIMULATED + str(folder / text.removeprefix(SIMULATED))
    if not is_recording(text):
        return text
    return str(folder / re.sub(r"(?i)^file:(//)?", "", text))

"""How a configuration says to reach the bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nodes.site.model import NodeConfig, SiteConfig

if TYPE_CHECKING:
    from nodes.bus.session import BusOptions


def bus_options(config: SiteConfig | NodeConfig) -> BusOptions:
    """For `nodes.bus.session.open_bus`."""
    from nodes.bus.session import BusOptions, TlsFiles

    site = config.name if isinstance(config, SiteConfig) else config.site
    tls = config.tls and TlsFiles(Path(config.tls.ca), Path(config.tls.certificate), Path(config.tls.key))
    return BusOptions(site, tuple(config.router), tls)

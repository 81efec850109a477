"""The three queries of the projection service, and where they are asked."""

from __future__ import annotations

from enum import StrEnum

from nodes.bus.keys import Keys


class Service(StrEnum):
    """What is asked for."""

    PROJECT = "project"
    LOCATE = "locate"
    BEARINGS = "bearings"


def service_key(keys: Keys, service: Service) -> str:
    """Where a query is asked."""
    match service:
        case Service.PROJECT:
            return keys.project_service
        case Service.LOCATE:
            return keys.locate_service
        case Service.BEARINGS:
            return keys.bearings_service

"""What the coordinator is to run."""

from __future__ import annotations

from dataclasses import dataclass

from nodes.coordinator.phases import Phase, Rules
from nodes.coordinator.session_folder import Saved, SessionFolder
from nodes.site.model import SiteConfig


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be run.

    Attributes:
        site: the configuration.
        site_text: of its file, for the recording.
        folder: of the session.
        saved: its state; of a new session the first one.
        rules: how it goes.
        is_resumed: the session was begun before.
    """

    site: SiteConfig
    site_text: str
    folder: SessionFolder
    saved: Saved
    rules: Rules
    is_resumed: bool = False


def first_plan(site: SiteConfig, site_text: str, folder: SessionFolder, *, is_auto: bool, now_s: float) -> Plan:
    """Of a session folder: a new session, or the one that is in it.

    Raises:
        InputError: its state cannot be read.
    """
    saved = folder.load()
    rules = rules_of(site, is_auto=is_auto)
    if saved is None:
        is_begun = (folder.path / "parts").is_dir()
        return Plan(site, site_text, folder, Saved(folder.path.name, now_s, Phase.IDLE, now_s), rules, is_begun)
    return Plan(site, site_text, folder, saved, rules, is_resumed=True)


def rules_of(site: SiteConfig, *, is_auto: bool) -> Rules:
    """How a session of a site goes."""
    times = site.session
    return Rules(times.background_s, times.min_waving_s, times.max_waving_s, is_auto=is_auto)

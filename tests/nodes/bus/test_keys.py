import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from network_calib.errors import InputError
from nodes.bus import keys as bus_keys
from nodes.bus.keys import Keys, Kind, LiveKey, ObservationKey, Role, Verb

names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", fullmatch=True)
no_names = st.one_of(
    st.sampled_from(["", "a/b", "*", "**", "$*", "@v1", "-a", ".a", "a b", "a?b", "a#b", "ä", "a\n", "a" * 65]),
    st.text(max_size=5).filter(lambda text: bus_keys.NAME.fullmatch(text) is None),
)


@given(site=names, node=names, kind=st.sampled_from(Kind))
def test_an_observation_key_is_parsed_to_what_built_it(site, node, kind):
    assert bus_keys.parse_observation(Keys(site).observation(node, kind)) == ObservationKey(site, node, kind)


@given(site=names, node=names, role=st.sampled_from(Role))
def test_a_live_key_is_parsed_to_what_built_it(site, node, role):
    assert bus_keys.parse_live(Keys(site).live(node, role)) == LiveKey(site, node, role)


@given(site=names, node=names, verb=st.sampled_from(Verb))
def test_status_and_command_keys_are_parsed_to_what_built_them(site, node, verb):
    assert bus_keys.parse_status(Keys(site).status(node)) == node
    assert bus_keys.parse_verb(Keys(site).command(node, verb)) == verb


@given(key=st.text(alphabet="ab/@*v1nodeobsliveevent", max_size=60))
def test_any_text_is_parsed_to_something_that_builds_it_again_or_to_none(key):
    observation, live = bus_keys.parse_observation(key), bus_keys.parse_live(key)
    assert observation is None or Keys(observation.site).observation(observation.node, observation.kind) == key
    assert live is None or Keys(live.site).live(live.node, live.role) == key


@given(name=no_names)
def test_what_is_no_name_builds_no_key(name):
    with pytest.raises(InputError, match="cannot stand in a key"):
        Keys(name)
    for build in (Keys("s1").status, Keys("s1").replay_rows, Keys("s1").replay_summary, Keys("s1").projection):
        with pytest.raises(InputError, match="cannot stand in a key"):
            build(name)
    with pytest.raises(InputError):
        Keys("s1").observation(name, Kind.SPOTS)


@pytest.mark.parametrize(
    "key",
    [
        "spotcal/@v2/s1/node/n1/obs/spots",
        "spotcal/@v1/s1/node/n1/obs/unknown",
        "spotcal/@v1/s1/node/*/obs/spots",
        "spotcal/@v1/s1/node/n1/obs",
        "spotcal/@v1/s1/node/n1/obs/spots/more",
        "/spotcal/@v1/s1/node/n1/obs/spots",
    ],
)
def test_other_keys_are_no_observations(key):
    assert bus_keys.parse_observation(key) is None


@given(site=names, node=names, kind=st.sampled_from(Kind), role=st.sampled_from(Role), verb=st.sampled_from(Verb))
def test_patterns_match_their_own_keys_and_no_journal(site, node, kind, role, verb):
    keys = Keys(site)
    pairs = [
        (keys.all_observations, keys.observation(node, kind)),
        (keys.all_status, keys.status(node)),
        (keys.all_live, keys.live(node, role)),
        (keys.all_commands(node), keys.command(node, verb)),
        (keys.all_summaries, keys.replay_summary(node)),
    ]
    for pattern, key in pairs:
        assert zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key))
    everything = zenoh.KeyExpr(f"{keys.base}/**")
    assert everything.includes(zenoh.KeyExpr(keys.observation(node, kind)))
    assert not everything.intersects(zenoh.KeyExpr(keys.replay_rows(node)))
    assert not zenoh.KeyExpr("spotcal/**").intersects(zenoh.KeyExpr(keys.status(node)))

import math

import numpy as np
import pytest

from network_calib.errors import InputError
from nodes.devices.tilt_unit import TiltUnit
from nodes.simulated.loopback import LoopbackTransport, VirtualClock
from nodes.simulated.smart_room import World, open_simulated, person_of, read_world, write_world
from nodes.simulated.smart_room_events import LEAD_S, EventFile, Move, Rest, Stop, Wave
from nodes.simulated.smart_room_geometry import DRIFT_RAD, HIGH_M, LOW_M, PLACE_SPREAD, PLACES, SmartRoom
from nodes.simulated.smart_room_lrf import smart_room_emulators
from nodes.simulated.smart_room_person import AWAY_S, RAISE_AMPLITUDE_M, RAISE_PERIOD_S

START_S = 1.8e9
RATE_HZ = 20.0


@pytest.fixture
def folder(tmp_path):
    write_world(tmp_path, World(3, START_S, RATE_HZ))
    return tmp_path


def person(folder):
    out = person_of(folder, read_world(folder))
    out.refresh()
    return out


class Wall:
    """A wall clock that somebody else's sleeping moves on."""

    def __init__(self, now_s):
        self.now_s = now_s

    def __call__(self):
        return self.now_s

    def sleep(self, seconds):
        self.now_s += seconds


def opened(folder, tail="", *, now_s=START_S):
    wall = Wall(now_s)
    return open_simulated(f"simulated:{folder}#C0{tail}", clock_s=wall, sleep=wall.sleep), wall


def test_world_comes_back_and_a_missing_one_is_told(folder, tmp_path):
    assert read_world(folder) == World(3, START_S, RATE_HZ)
    with pytest.raises(InputError, match=r"world\.json cannot be read"):
        read_world(tmp_path / "elsewhere")


def test_half_a_line_is_read_when_its_end_comes(folder):
    events = EventFile(folder)
    with events.path.open("wb") as file:
        file.write(b'{"kind": "move", "ti')
        file.flush()
        assert events.new() == []
        file.write(b'me_s": 5.0}\n')
    assert events.new() == [Move(5.0)]
    assert events.new() == []


def test_no_event_is_refused_with_its_line(folder):
    EventFile(folder).path.write_text('{"kind": "dance"}\n')
    with pytest.raises(InputError, match="dance"):
        person(folder)


def test_nobody_is_there_but_while_waving(folder):
    EventFile(folder).append(Wave(START_S + 2.0, 10.0))
    someone = person(folder)
    assert [someone.is_shining(t) for t in (1.99, 2.0, 11.99, 12.0)] == [False, True, True, False]


def test_waving_stops_when_told(folder):
    events = EventFile(folder)
    events.append(Wave(START_S + 2.0, 10.0))
    events.append(Stop(START_S + 5.0))
    someone = person(folder)
    assert [someone.is_shining(t) for t in (4.99, 5.0)] == [True, False]


def test_waved_spot_stays_in_the_room_and_is_no_faster_than_a_hand(folder):
    EventFile(folder).append(Wave(START_S, 60.0))
    someone = person(folder)
    times = np.arange(0.0, 60.0, 0.01)
    way = np.concatenate([someone.at(times[k : k + 1]) for k in range(len(times))])
    assert (way > np.array(LOW_M) + 0.2).all()
    assert (way < np.array(HIGH_M) - 0.2).all()
    speed = np.linalg.norm(np.diff(way, axis=0), axis=1) / 0.01
    # Sweeps of 4.2, 3 and 1.85 m in 7.3, 4.1 and 2.57 s: 1.2 m/s together where all are at their mean speeds.
    assert 0.6 < speed.mean() < 1.5
    assert speed.max() < 3.0


def test_times_of_equal_difference_give_the_same_way_whenever_the_world_began(tmp_path):
    """The clock's seconds since 1970 are known to a quarter of a microsecond; frames must be the same to the bit."""
    ways = []
    for number, start_s in enumerate((START_S, START_S + 12345.678)):
        folder = tmp_path / str(number)
        write_world(folder, World(3, start_s, RATE_HZ))
        EventFile(folder).append(Wave(start_s + 2.35, 10.0))
        ways.append(person(folder).at(np.array([4.05])))
    assert (ways[0] == ways[1]).all()


def test_spot_is_raised_through_the_plane_while_the_unit_rests(folder):
    tilt_rad = math.radians(12.0)
    events = EventFile(folder)
    events.append(Rest(START_S + 1.0, tilt_rad))
    events.append(Move(START_S + 30.0))
    someone, room = person(folder), SmartRoom.of(3)
    begin_s = 1.0 + AWAY_S
    assert someone.spot_in_world(begin_s - 0.01) is None
    for turn in range(6):
        place = someone.spot_in_world(begin_s + (turn + 0.25) * RAISE_PERIOD_S)
        top = someone.spot_in_world(begin_s + (turn + 0.5) * RAISE_PERIOD_S)
        assert place is not None
        assert top is not None
        range_m, bearing_rad, height_m = room.scanner.measure(place[None], tilt_rad)
        # In the plane, at the place of that turn; products of numbers below 10.
        assert abs(height_m[0]) < 1e-12
        assert range_m[0] == pytest.approx(PLACES[turn][0], abs=PLACE_SPREAD[0])
        assert bearing_rad[0] == pytest.approx(PLACES[turn][1], abs=PLACE_SPREAD[1] + DRIFT_RAD / 2)
        assert room.scanner.measure(top[None], tilt_rad)[2][0] == pytest.approx(RAISE_AMPLITUDE_M, abs=1e-12)
    # Everybody knows of the move by then.
    assert someone.spot_in_world(30.0 + LEAD_S - 0.01) is not None
    assert someone.spot_in_world(30.0 + LEAD_S + 0.01) is None


@pytest.mark.parametrize("seed", range(5))
def test_stereo_pair_sees_every_place_at_every_tilt(seed):
    room = SmartRoom.of(seed)
    for tilt_deg in (2.0, 12.0, 23.0):
        places = np.array([room.place_in_world(math.radians(tilt_deg), k, 0.5) for k in range(2 * len(PLACES))])
        for camera in (0, 1):
            index = np.full(len(places), camera)
            px, is_valid = room.cameras.img_from_world(index, places)
            assert (is_valid & room.cameras.is_in_image(index, px)).all()


def test_live_camera_keeps_the_grid_and_counts_what_a_slow_reader_misses(folder):
    source, wall = opened(folder, now_s=START_S + 10.01)
    frames = iter(source)
    first = next(frames)
    # Frame 200 was exposed 10 s after the start; the next one is the first that is waited for.
    assert first.sequence == 201
    assert first.stamp_ns == round(START_S * 1e9) + 201 * 50_000_000
    wall.now_s += 0.5
    late = next(frames)
    assert late.sequence == 211
    assert source.counts.dropped == 9
    source.close()
    assert next(frames, None) is None


def test_every_frame_comes_though_late_and_is_the_one_of_the_live_camera(folder):
    EventFile(folder).append(Wave(START_S + 1.0, 10.0))
    live, _ = opened(folder, now_s=START_S + 2.01)
    wanted = next(iter(live))
    source, wall = opened(folder, "?every&first=40", now_s=START_S + 100.0)
    frames = [frame for frame, _ in zip(source, range(2), strict=False)]
    assert [frame.sequence for frame in frames] == [40, 41]
    assert frames[1].sequence == wanted.sequence
    assert frames[1].stamp_ns == wanted.stamp_ns
    assert (frames[1].image == wanted.image).all()
    assert source.counts.dropped == 0
    assert wall.now_s == START_S + 100.0


def test_no_frame_comes_before_its_time(folder):
    source, wall = opened(folder, "?every&first=4", now_s=START_S - 1.0)
    next(iter(source))
    # Half an exposure of 4 ms after 4 periods.
    assert wall.now_s == pytest.approx(START_S + 4 / RATE_HZ + 0.002, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("simulated:#C0", "no simulated camera"),
        ("simulated:{}", "no simulated camera"),
        ("simulated:{}#C9", "no camera 'C9'"),
        ("simulated:{}#C0?fast", "not known"),
        ("simulated:{}#C0?every&first=-1", "not known"),
    ],
)
def test_other_texts_are_refused(folder, text, told):
    with pytest.raises(InputError, match=told):
        open_simulated(text.format(folder))


def test_unit_that_comes_to_rest_and_moves_on_tells_the_world(folder):
    clock = VirtualClock()
    emulators = smart_room_emulators(folder, read_world(folder), zero_s=START_S + 7.0)
    unit = TiltUnit(LoopbackTransport(emulators["ptu"], clock), clock=clock)
    unit.start()
    unit.go_to(math.radians(12.0))
    events = EventFile(folder).new()
    rest = events[-1]
    assert isinstance(rest, Rest)
    # A step is 0.0514 degrees; with the gear's play of one step the load is off by up to as much.
    assert math.degrees(rest.tilt_rad) == pytest.approx(12.0, abs=0.0514)
    assert START_S + 7.0 < rest.time_s <= START_S + 7.0 + clock()
    unit.go_to(math.radians(2.0))
    assert any(isinstance(event, Move) and event.time_s > rest.time_s for event in EventFile(folder).new())

"""The documentation's examples, run: Python against a service, and programs that know nothing but `spotcal.proto`."""

import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from nodes.bus.session import open_bus
from nodes.projection import Calibration
from nodes.projection.points import Beams
from nodes.projection.questions import QUERY
from nodes.projection.requests import ProjectAsked
from nodes.projection.wire import encode
from nodes.projection.wire_answers import projected_of
from tests.nodes.bus.buses import KEYS, options_of, routed, wait_until
from tests.nodes.projection.served import SITE, serving, write_calibration

PROTOBUFJS = "protobufjs@8.8.1"
INSTALL_S, RUN_S = 60, 60
ASKED = Beams("L0", np.array([2.5, np.nan]), np.array([0.0, 0.1]), 0.4)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A router's address, and the calibration that the service behind it answers under."""
    path = write_calibration(tmp_path_factory.mktemp("calibration") / "calibration.json")
    with routed() as endpoint, serving(endpoint, path) as said:
        wait_until(lambda: len(said) == 2, "the service to answer")
        yield endpoint, Calibration.load(path)


@pytest.fixture(scope="module")
def examples(request):
    """Code blocks of docs/projection.md, by language."""
    text = (request.config.rootpath / "docs" / "projection.md").read_text(encoding="utf-8")
    return dict(re.findall(r"^```(python|js)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))


@pytest.fixture(scope="module")
def tracker(examples, tmp_path_factory):
    """The documentation's JavaScript, ready to run in a folder of its own."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("neither Node.js nor npm is installed")
    folder = tmp_path_factory.mktemp("tracker")
    install = [npm, "install", "--prefer-offline", "--no-audit", "--no-fund", "--ignore-scripts", PROTOBUFJS]
    try:
        done = subprocess.run(install, cwd=folder, capture_output=True, text=True, timeout=INSTALL_S, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip(f"npm could not install {PROTOBUFJS} in time")
    if done.returncode:
        pytest.skip(f"npm could not install {PROTOBUFJS}: {done.stderr.strip()[-200:]}")
    program = folder / "tracker.mjs"
    program.write_text(examples["js"], encoding="utf-8")
    return [node, str(program)]


def ask(endpoint, request):
    """The reply to bytes, which are sent as they are."""
    with open_bus(options_of(endpoint)) as bus:
        (reply,) = bus.get(KEYS.project_service, payload=request, timeout=20.0, **QUERY)
        assert reply.ok is not None
        return reply.ok.payload.to_bytes()


def test_a_tracker_in_javascript_asks_and_reads_the_answer(tracker, served, root, tmp_path):
    endpoint, calibration = served
    proto = str(root / "nodes" / "bus" / "spotcal.proto")

    def run(action):
        command = [*tracker, proto, action, str(tmp_path / f"{action}.bin")]
        return subprocess.run(command, capture_output=True, text=True, timeout=RUN_S, check=True).stdout

    run("request")
    request = (tmp_path / "request.bin").read_bytes()
    assert request == encode(ProjectAsked(ASKED))
    (tmp_path / "reply.bin").write_bytes(ask(endpoint, request))
    rows = [line.split(" ") for line in run("reply").splitlines()]
    expected = calibration.project(ASKED)
    assert [row[0] for row in rows] == np.repeat(expected.cameras, 2).tolist()
    # JavaScript prints the shortest digits that read back to the same double, as Python does.
    px = np.array([row[3:] for row in rows], dtype=np.float64).reshape(expected.px.shape)
    np.testing.assert_array_equal(px, expected.px)
    assert [row[2] for row in rows] == [str(int(is_valid)) for is_valid in expected.is_valid.ravel()]


def test_protoc_alone_reads_the_bytes_of_request_and_answer(served, root):
    pytest.importorskip("grpc_tools.protoc")
    endpoint, calibration = served
    request = encode(ProjectAsked(ASKED))

    def decoded(message, payload):
        command = [sys.executable, "-m", "grpc_tools.protoc", f"--decode=spotcal.v1.{message}", f"--proto_path={root}"]
        done = subprocess.run(
            [*command, str(root / "nodes" / "bus" / "spotcal.proto")],
            input=payload,
            capture_output=True,
            timeout=RUN_S,
            check=True,
        )
        return done.stdout.decode()

    assert re.search(
        r'^beams \{\n  lrf: "L0"\n  range_m: ".*"\n  bearing_rad: ".*"\n', decoded("ProjectRequest", request)
    )
    told = decoded("ProjectReply", ask(endpoint, request))
    assert f'calibration_id: "{calibration.id}"' in told
    assert "n_points: 2\n" in told
    # Everything has a name: nothing in the bytes is unknown to the file.
    assert not re.search(r"^\s*\d+:", told, re.MULTILINE)


def test_what_python_sends_is_what_the_proto_file_says(served):
    """The documented layout, taken apart by hand: little-endian doubles, the last index fastest."""
    endpoint, calibration = served
    reply = ask(endpoint, encode(ProjectAsked(ASKED)))
    expected = calibration.project(ASKED)
    assert np.ascontiguousarray(expected.px).astype("<f8").tobytes() in reply
    assert expected.is_valid.astype(np.uint8).tobytes() in reply
    np.testing.assert_array_equal(projected_of(reply).px, expected.px)


def test_the_python_of_the_documentation_runs(served, examples, capsys):
    endpoint, _ = served
    source = examples["python"].replace('"lab"', f'"{SITE}"').replace("tcp/127.0.0.1:7447", endpoint)
    exec(compile(source, "docs/projection.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("('C0', 'C1', ")
    assert lines[-1].startswith("UNKNOWN_CAMERA no camera 'no such camera'")
    # "nothing but rounding": points of noise-free pixels, back to their bearings.
    way_back = np.array(re.findall(r"-?\d\.\d*e?[-+]?\d*", " ".join(lines[2:-1])), dtype=np.float64)
    assert len(way_back) > 20
    assert np.abs(way_back).max() < 1e-9

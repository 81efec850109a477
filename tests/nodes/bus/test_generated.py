import pytest


@pytest.mark.parametrize("name", ["spotcal_pb2.py", "spotcal_pb2.pyi"])
def test_the_generated_code_is_what_the_proto_file_makes(root, tmp_path, name):
    # In this process: `scripts/protoc` would first look after the environment.
    protoc = pytest.importorskip("grpc_tools.protoc")
    source = root / "nodes" / "bus" / "spotcal.proto"
    arguments = [f"--proto_path={root}", f"--python_out={tmp_path}", f"--pyi_out={tmp_path}", str(source)]
    assert protoc.main(["protoc", *arguments]) == 0
    made = (tmp_path / "nodes" / "bus" / name).read_text()
    assert made == (root / "nodes" / "bus" / name).read_text(), "run scripts/protoc"

"""Files of weights: what is read, what is refused, and that nothing of a file is run."""

import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

from spdm_models import checkpoint
from spdm_models.checkpoint import read_checkpoint, read_metadata, write_checkpoint
from spdm_models.state_dict import Extras, flatten, from_state_dict, to_state_dict

VALUES = np.arange(6, dtype=np.float32)
# A pickle's opcodes: global, mark, tuple, call, binary persistent id, set items, stop.
DICT = b"ccollections\nOrderedDict\n(tR"


def text(value: str) -> bytes:
    return b"V" + value.encode() + b"\n"


def numbers(*values: int) -> bytes:
    return b"(" + b"".join(b"I%d\n" % v for v in values) + b"t"


def tensor(storage: str, key: str, count: int, offset: int, size, stride) -> bytes:
    """Opcodes of one tensor, as torch writes them."""
    identity = b"(" + text("storage") + b"ctorch\n%s\n" % storage.encode()
    identity += text(key) + text("cpu") + b"I%d\n" % count + b"tQ"
    layout = b"I%d\n" % offset + numbers(*size) + numbers(*stride)
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + identity + layout + b"I00\n" + DICT + b"tR"


def pickled(items: dict[str, bytes]) -> bytes:
    body = b"".join(text(name) + value for name, value in items.items())
    return b"\x80\x02" + DICT + b"(" + body + b"u."


def torch_file(path: Path, pickle: bytes, order: str = "little", **storages: np.ndarray) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/data.pkl", pickle)
        archive.writestr("model/byteorder", order)
        for key, values in storages.items():
            archive.writestr(f"model/data/{key.removeprefix('s')}", values.tobytes())
    return path


def test_torchs_layout(tmp_path: Path):
    items = {
        "a.weight": tensor("FloatStorage", "0", 6, 0, (2, 3), (3, 1)),
        "a.turned": tensor("FloatStorage", "0", 6, 0, (3, 2), (1, 3)),
        "part": tensor("FloatStorage", "0", 6, 4, (2,), (1,)),
        "count": tensor("LongStorage", "1", 1, 0, (), ()),
        "half": tensor("BFloat16Storage", "2", 2, 0, (2,), (1,)),
        "empty": tensor("FloatStorage", "0", 6, 0, (0, 3), (3, 1)),
    }
    half = np.array([0.5, 3], jnp.bfloat16)
    storages = {"s0": VALUES, "s1": np.array([7], np.int64), "s2": half}
    path = torch_file(tmp_path / "w.pth", pickled(items), **storages)
    read = read_checkpoint(path)
    np.testing.assert_array_equal(read["a.weight"], VALUES.reshape(2, 3))
    np.testing.assert_array_equal(read["a.turned"], VALUES.reshape(2, 3).T)
    np.testing.assert_array_equal(read["part"], [4, 5])
    assert read["count"].dtype == np.int64 and read["count"] == 7
    assert read["half"].dtype == np.float32 and list(read["half"]) == [0.5, 3]
    assert read["empty"].shape == (0, 3)
    swapped = torch_file(
        tmp_path / "big.pth", pickled({"x": items["part"]}), "big", s0=VALUES.byteswap()
    )
    np.testing.assert_array_equal(read_checkpoint(swapped)["x"], [4, 5])


def test_what_torch_saves(tmp_path: Path):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    module = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.LSTM(2, 4))
    expected = {name: value.numpy() for name, value in module.state_dict().items()}
    path = tmp_path / "w.pth"
    torch.save({"model": module.state_dict(), "epoch": 3}, path)
    with pytest.raises(ValueError, match=r"w\.pth: epoch is 3, no array; .* by its prefix"):
        read_checkpoint(path)
    read = read_checkpoint(path, "model")
    assert read.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(read[name], value)
    torch.save(dict(module.named_parameters()), path)
    assert read_checkpoint(path).keys() == expected.keys()
    torch.save(module, path)
    with pytest.raises(ValueError, match=r"w\.pth: .* torch\.nn\.modules\.container\.Sequential"):
        read_checkpoint(path)


@pytest.mark.parametrize("call", [b"cposix\nsystem\n", b"cbuiltins\neval\n", b"ctorch\nload\n"])
def test_nothing_of_a_file_is_run(tmp_path: Path, call: bytes):
    mark = tmp_path / "ran"
    attack = b"\x80\x02" + call + b"(" + text(f"open({str(mark)!r}, 'w')") + b"tR."
    with pytest.raises(ValueError, match=r"w\.pth: .*no part of plain weights"):
        read_checkpoint(torch_file(tmp_path / "w.pth", attack))
    assert not mark.exists()


def test_a_file_cannot_change_the_reader(tmp_path: Path):
    """BUILD sets attributes of what a name resolves to: it must not outlive the file."""
    rebuild = b"ctorch._utils\n_rebuild_tensor_v2\n"
    build = rebuild + b"(N(" + text("__doc__") + text("changed") + b"dtb"
    path = torch_file(tmp_path / "w.pth", pickled({"x": build}), s0=VALUES)
    with pytest.raises(ValueError, match=r"x is .*no array"):
        read_checkpoint(path)
    assert checkpoint._tensor.__doc__ != "changed"
    # A dict that contains itself: memoised, then stored under its own key.
    cyclic = b"\x80\x02" + DICT + b"p0\n(" + text("x") + b"g0\nu."
    with pytest.raises(ValueError, match="contain themselves"):
        read_checkpoint(torch_file(tmp_path / "w.pth", cyclic))


@pytest.mark.parametrize(
    "opcodes, message",
    [
        (tensor("FloatStorage", "0", 6, 0, (3, 3), (3, 1)), "beyond its storage"),
        (tensor("FloatStorage", "0", 6, 0, (2,), (-1,)), "beyond its storage"),
        (tensor("FloatStorage", "0", 7, 0, (2,), (1,)), "cut short"),
        (tensor("FloatStorage", "9", 6, 0, (2,), (1,)), "data/9"),
        (tensor("QUInt8Storage", "0", 6, 0, (2,), (1,)), "QUInt8Storage"),
        (b"I1", "no readable torch checkpoint"),
        (tensor("FloatStorage", "0", 6, 0, (-1,), (1,)), "no readable torch checkpoint"),
        (b"(" + text("storage") + b"tQ", "no readable torch checkpoint"),
        (b"ctorch\nFloatStorage\n(I1\ntR", "no readable torch checkpoint"),
    ],
)
def test_damaged_torch_files(tmp_path: Path, opcodes: bytes, message: str):
    path = torch_file(tmp_path / "w.pth", pickled({"x": opcodes}), s0=VALUES)
    with pytest.raises(ValueError, match=message) as raised:
        read_checkpoint(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("w.pth", b"\x80\x02}q\x00.", "not the zip format"),
        ("w.npz", b"PK\x03\x04", "no readable .npz"),
        ("w.safetensors", b"\x05", "no readable .safetensors"),
        ("w.onnx", b"", "ending '.onnx'"),
    ],
)
def test_other_files(tmp_path: Path, name: str, content: bytes, message: str):
    path = tmp_path / name
    with pytest.raises(FileNotFoundError, match=name):
        read_checkpoint(path)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as raised:
        read_checkpoint(path)
    assert str(path) in str(raised.value)


def test_written_files_come_back(tmp_path: Path):
    state = {"a.weight": VALUES.reshape(2, 3).T, "b": np.arange(3), "c": np.float64(2.5)}
    path = tmp_path / "w.safetensors"
    write_checkpoint(path, state, {"model": "gameformer", "modes": 6})
    assert read_metadata(path) == {"model": "gameformer", "modes": 6}
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    for read in (read_checkpoint(path), load_file(path)):
        for name, value in state.items():
            np.testing.assert_array_equal(read[name], value)
            assert read[name].dtype == np.asarray(value).dtype
    np.savez(tmp_path / "w.npz", allow_pickle=False, **state)
    assert read_checkpoint(tmp_path / "w.npz").keys() == state.keys()
    assert read_metadata(tmp_path / "w.npz") == {}
    with pytest.raises(ValueError, match=r"\.safetensors"):
        write_checkpoint(tmp_path / "w.pth", state)


TEMPLATE = {"a": {"weight": np.zeros((2, 3))}, "shared": {0: {"bias": np.zeros(2)}}}
EXTRAS = Extras(aliases={"shared.1": "shared.0"}, constants={"index": np.arange(4)})


def good_state() -> dict[str, np.ndarray]:
    bias = np.ones(2)
    return {
        "a.weight": np.ones((2, 3)),
        "shared.0.bias": bias,
        "shared.1.bias": bias,
        "index": np.arange(4),
    }


def test_state_dict_round_trip():
    params = from_state_dict(good_state(), TEMPLATE, EXTRAS)
    assert list(flatten(params)) == ["a.weight", "shared.0.bias"]
    assert params["shared"][0]["bias"].dtype == np.float32
    back = to_state_dict(params, EXTRAS)
    assert back.keys() == good_state().keys()
    np.testing.assert_array_equal(back["shared.1.bias"], [1, 1])
    few = {k: v for k, v in good_state().items() if k in ("a.weight", "shared.0.bias")}
    assert flatten(from_state_dict(few, TEMPLATE, EXTRAS)).keys() == flatten(params).keys()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"a.weight": None}, "a.weight is missing"),
        ({"b.weight": np.ones(2)}, "b.weight is unknown to this model"),
        ({"a.weight": np.ones((3, 2))}, r"a.weight has shape \(3, 2\), expected \(2, 3\)"),
        ({"a.weight": np.full((2, 3), np.nan)}, "a.weight holds 6 values that are not finite"),
        ({"shared.0.bias": np.array([1, np.inf])}, "shared.0.bias holds 1 values"),
        ({"a.weight": np.ones((2, 3), int)}, "a.weight has dtype int64"),
        ({"shared.1.bias": np.zeros(2)}, "shared.1.bias must be the same as shared.0.bias"),
        ({"shared.1.other": np.zeros(2)}, "shared.1.other is unknown"),
        ({"index": np.zeros(4, int)}, "index differs from what this configuration gives"),
    ],
)
def test_state_dict_names_what_does_not_fit(change, message: str):
    state = {k: v for k, v in {**good_state(), **change}.items() if v is not None}
    with pytest.raises(ValueError, match=message) as raised:
        from_state_dict(state, TEMPLATE, EXTRAS, "w.pth")
    assert str(raised.value).startswith("w.pth does not fit the model")


def test_state_dict_lists_all_problems_but_not_thousands():
    state = {f"x{i}": np.ones(1) for i in range(40)}
    with pytest.raises(ValueError, match=r"(?s)42 keys\n  x0 .*and 30 more") as raised:
        from_state_dict(state, TEMPLATE)
    assert "x11" in str(raised.value) and "x12" not in str(raised.value)

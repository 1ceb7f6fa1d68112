"""Photographs: read whole or not at all, told apart from empty ones, found by camera and shot."""

from __future__ import annotations

import contextlib
import struct
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from implicam import images
from implicam.detect.folder import note_turned
from implicam.detect.model import View
from implicam.errors import ImageError, UsageError
from implicam.films import Film
from implicam.hardware import OpenCVCamera
from implicam.images import blank, eight_bit, one_thread_each, read_picture, stored_jpeg, write_picture
from implicam.picture_heads import read_head
from implicam.picture_names import find_pictures, in_order

cv2 = pytest.importorskip("cv2")

LUMA = np.array([0.114, 0.587, 0.299])  # blue, green, red: ITU-R BT.601


@pytest.fixture(autouse=True)
def quiet():
    with one_thread_each():
        yield


def scene(shape=(48, 64), bits=8, channels=1, seed=0):
    """Smooth, so that JPEG keeps it, with a little noise, so that files are not tiny."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: shape[0], : shape[1]]
    layers = [0.5 + 0.3 * np.sin(u / 9 + c) * np.cos(v / 11 - c) + rng.normal(0, 0.01, shape) for c in range(channels)]
    most = 2**bits - 1
    image = np.rint(np.stack(layers, axis=-1) * most).astype(np.uint8 if bits == 8 else np.uint16)
    return image[..., 0] if channels == 1 else image


def saved(path: Path, image, *options) -> Path:
    good, encoded = cv2.imencode(path.suffix, image, list(options))
    assert good
    path.write_bytes(encoded.tobytes())
    return path


@pytest.mark.parametrize("ending", [".png", ".tif", ".tiff"])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_every_form_is_read_as_grey_from_0_to_1(tmp_path, ending, bits, channels):
    image = scene(bits=bits, channels=channels)
    grey = read_picture(saved(tmp_path / f"a{ending}", image))
    colour = image[..., :3] @ LUMA if channels > 1 else image.astype(float)
    assert grey.dtype == np.float32
    assert grey.shape == (48, 64)
    # colour is rounded to whole steps by OpenCV
    np.testing.assert_allclose(grey * (2**bits - 1), colour, atol=0.02 if channels == 1 else 1.0)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_turn_that_exif_asks_for_is_named_with_both_sizes(tmp_path, orientation, order):
    path = saved(tmp_path / "a.jpg", scene())
    exif = b"Exif\0\0" + (b"II" if order == "<" else b"MM") + struct.pack(order + "HIH", 42, 8, 2)
    exif += struct.pack(order + "HHIHH", 0x0100, 3, 1, 64, 0) + struct.pack(
        order + "HHIHH", 0x0112, 3, 1, orientation, 0
    )
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    assert cv2.imread(str(path)).shape[:2] == ((64, 48) if orientation > 4 else (48, 64))
    assert read_picture(path).shape == (48, 64)
    stored = stored_jpeg(path)
    assert (stored.size, stored.orientation) == ((64, 48), orientation)
    assert stored.shown == ((48, 64) if orientation > 4 else (64, 48))
    (tmp_path / "b.jpg").write_bytes(data)
    notes = note_turned({View("left", "a"): path, View("left", "b"): tmp_path / "b.jpg"})
    assert len(notes) == (orientation != 1)
    assert all("64 x 48 stored, " in note and "was turned between" in note for note in notes)
    for cut in range(0, len(data), 7):
        path.write_bytes(path.read_bytes()[:cut])
        assert stored_jpeg(path) is None or stored.size == (64, 48)


def test_jpeg_is_read_within_its_loss(tmp_path):
    image = scene(channels=3)
    grey = read_picture(saved(tmp_path / "a.JPG".lower(), image, cv2.IMWRITE_JPEG_QUALITY, 98))
    assert np.abs(grey * 255 - image @ LUMA).max() < 6


def test_limits_are_exact(tmp_path):
    for bits, kind in ((8, np.uint8), (16, np.uint16)):
        image = np.array([[0, 2**bits - 1]], dtype=kind)
        assert read_picture(saved(tmp_path / "a.png", image)).tolist() == [[0.0, 1.0]]


def test_what_is_written_is_read(tmp_path):
    picture = np.linspace(0, 1, 64 * 48, dtype=np.float32).reshape(48, 64)
    for bits in (8, 16):
        write_picture(tmp_path / "a.png", picture, bits=bits)
        assert np.abs(read_picture(tmp_path / "a.png") - picture).max() <= 0.5001 / (2**bits - 1)
    with pytest.raises(UsageError, match="no name for a picture"):
        write_picture(tmp_path / "a.xyz", picture)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png"]


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif"])
def test_a_picture_cut_off_anywhere_is_no_picture(tmp_path, ending):
    whole = saved(tmp_path / f"whole{ending}", scene((120, 160), channels=3)).read_bytes()
    path = tmp_path / f"cut{ending}"
    for tenth in range(1, 10):
        path.write_bytes(whole[: len(whole) * tenth // 10])
        with pytest.raises(ImageError, match=r"cut(\.\w+) is (cut off|damaged or cut off)") as told:
            read_picture(path)
        assert "copy it again" in told.value.fix
    path.write_bytes(whole)
    assert read_picture(path).shape == (120, 160)


def jpeg_with(segment: bytes, jpeg: bytes) -> bytes:
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def test_the_end_of_a_preview_is_not_the_end_of_the_picture(tmp_path):
    preview = cv2.imencode(".jpg", scene((16, 16)))[1].tobytes()
    whole = jpeg_with(b"Exif\0\0" + preview, cv2.imencode(".jpg", scene((40, 40)))[1].tobytes())
    path = tmp_path / "a.jpg"
    path.write_bytes(whole)
    assert read_picture(path).shape == (40, 40)
    for end in (len(preview) + 40, len(whole) - 2, len(whole) * 3 // 4):
        path.write_bytes(whole[:end])
        with pytest.raises(ImageError, match="cut off"):
            read_picture(path)


def test_what_follows_a_whole_picture_does_not_matter(tmp_path):
    """Phones append a film of megabytes to a JPEG; some programs pad a PNG."""
    for ending, image in ((".jpg", scene()), (".png", scene())):
        path = saved(tmp_path / f"a{ending}", image)
        path.write_bytes(path.read_bytes() + bytes(20_000))
        assert read_picture(path).shape == (48, 64)


def test_progressive_jpeg(tmp_path):
    path = saved(tmp_path / "a.jpg", scene(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    assert read_picture(path).shape == (48, 64)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ImageError, match="cut off"):
        read_picture(path)


def test_pixels_are_those_of_the_sensor_whatever_exif_asks_for(tmp_path):
    orientation = struct.pack("<HHII", 0x0112, 3, 1, 6)  # turn by 90 degrees
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + orientation + bytes(4)
    path = tmp_path / "a.jpg"
    path.write_bytes(jpeg_with(exif, cv2.imencode(".jpg", scene((48, 64)))[1].tobytes()))
    assert cv2.imread(str(path)).shape[:2] == (64, 48)  # the tag is understood
    assert read_picture(path).shape == (48, 64)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "is empty"), (b"a text", "not a picture"), (bytes(5000), "not a picture"), (b"\xff\xd8\xff", "cut off")],
)
def test_what_is_no_picture_is_told(tmp_path, content, words):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(ImageError, match=words) as told:
        read_picture(tmp_path / "a.png")
    assert "a.png" in told.value.what
    assert told.value.fix


def test_files_that_cannot_be_read(tmp_path):
    (tmp_path / "folder.png").mkdir()
    for name in ("folder.png", "missing.png"):
        with pytest.raises(ImageError, match=rf"{name} cannot be read"):
            read_picture(tmp_path / name)
    saved(tmp_path / "a.tif", np.zeros((4, 4), np.float32))
    with pytest.raises(ImageError, match="holds float32 numbers"):
        read_picture(tmp_path / "a.tif")


def test_one_pixel_is_a_picture(tmp_path):
    saved(tmp_path / "a.png", np.full((1, 1), 51, np.uint8))
    assert read_picture(tmp_path / "a.png").tolist() == [[pytest.approx(0.2)]]
    assert eight_bit(read_picture(tmp_path / "a.png")).shape == (1, 1)


def test_a_png_that_claims_to_be_enormous(tmp_path):
    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )
    with pytest.raises(ImageError, match=r"a\.png"):
        read_picture(tmp_path / "a.png")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_bytes_give_a_picture_or_an_image_error(tmp_path_factory, data):
    ending = data.draw(st.sampled_from([".png", ".jpg", ".tif"]))
    content = bytearray(cv2.imencode(ending, scene((20, 24)))[1].tobytes())
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("fuzz") / f"a{ending}"
    path.write_bytes(content)
    with contextlib.suppress(ImageError):
        assert read_picture(path).dtype == np.float32


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("level", "word"), [(0.0, "black"), (0.4, "uniformly grey"), (1.0, "white")])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
def test_a_picture_of_nothing_but_noise_is_blank(bits, level, word, noise):
    rng = np.random.default_rng(5)
    most = 2**bits - 1
    for shape in ((1, 1), (3, 50), (200, 320), (480, 640)):
        for _ in range(5):
            picture = np.clip(np.rint((level + rng.normal(0, noise, shape)) * most), 0, most) / most
            assert blank(picture.astype(np.float32)) == word


def test_noise_is_taken_for_a_scene_less_than_once_in_hundreds():
    rng = np.random.default_rng(6)
    seen = sum(blank((0.3 + rng.normal(0, 0.05, (96, 128))).astype(np.float32)) == "" for _ in range(600))
    assert seen <= 3


def test_little_is_not_nothing():
    rng = np.random.default_rng(7)

    def noisy(picture, noise):
        return (picture + rng.normal(0, noise, picture.shape)).astype(np.float32)

    v, u = np.mgrid[:480, :640]
    dot = 0.02 + 0.5 * np.exp(-((u - 300.3) ** 2 + (v - 99.8) ** 2) / (2 * 1.5**2))
    star = np.zeros((480, 640))
    star[200:202, 300:302] = 1.0
    faint = 0.01 + 0.004 * ((u - 320) ** 2 + (v - 240) ** 2 < 30**2)  # a few of 255 steps, as in 10 of 16 bits
    board = 0.1 + 0.7 * ((u // 9 + v // 9) % 2)
    for picture, noise in ((dot, 0.01), (star, 0.0), (faint, 0.001), (board, 0.05), (u / 2000 + 0.2, 0.02)):
        assert blank(noisy(picture, noise)) == ""


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def found(folder: Path, *more, **named) -> dict[str, list[str]]:
    return {camera: list(shots) for camera, shots in find_pictures(folder, *more, **named).items()}


def test_pictures_are_found_and_counted_as_people_do(tmp_path):
    touch(tmp_path, "cam 10/img10.PNG", "cam 10/img2.png", "cam 2/img2.tif", "cam 2/Übung ä.jpeg", "cam 2/a.b.jpg")
    touch(tmp_path, "cam 2/notes.txt", "cam 2/.hidden.png", ".thumbs/img2.png", "loose.png", "cam 2/deeper/x.png")
    (tmp_path / "cam 2" / "x.png").mkdir()
    assert found(tmp_path) == {"cam 2": ["a.b", "img2", "Übung ä"], "cam 10": ["img2", "img10"]}


def test_pictures_by_a_pattern(tmp_path):
    touch(tmp_path, "7_left.png", "8_left.png", "a_b_right.png", "plain.png")
    assert found(tmp_path, "{shot}_{camera}") == {"left": ["7", "8"], "right": ["a_b"]}
    assert found(tmp_path, "{shot}_{camera}.png") == {"left": ["7", "8"], "right": ["a_b"]}
    touch(tmp_path / "deep", "run 1/c1/007.png", "run 2/c1/007.png")
    assert found(tmp_path / "deep", "run 1/{camera}/{shot}") == {"c1": ["007"]}


def test_known_cameras_say_where_their_names_end(tmp_path):
    touch(tmp_path, "cam_1_003.png", "cam_10_003.png", "other_9.png")
    assert found(tmp_path, "{camera}_{shot}") == {"cam": ["1_003", "10_003"], "other": ["9"]}
    named = found(tmp_path, "{camera}_{shot}", ["cam_1", "cam_10"])
    assert named == {"cam_1": ["003"], "cam_10": ["003"], "other": ["9"]}


def test_folders_behind_links_are_found_and_loops_end(tmp_path):
    touch(tmp_path / "disk", "c1/1.png")
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "c1").symlink_to(tmp_path / "disk" / "c1")
    (tmp_path / "images" / "loop").symlink_to(tmp_path / "images")
    (tmp_path / "images" / "broken.png").symlink_to(tmp_path / "nowhere")
    assert found(tmp_path / "images") == {"c1": ["1"]}


def test_mistakes_in_the_place_of_pictures_are_told(tmp_path):
    with pytest.raises(ImageError, match="no folder"):
        find_pictures(tmp_path / "images")
    with pytest.raises(ImageError, match="holds no picture that fits"):
        find_pictures(tmp_path)
    touch(tmp_path, "c/1.png", "c/1.jpg")
    with pytest.raises(ImageError, match=r"1\.jpg and .*1\.png are both the picture of shot '1'"):
        find_pictures(tmp_path)
    for pattern in ("{camera}", "{shot}", "x", "{camera}/{shot}/{shot}", ""):
        with pytest.raises(UsageError, match="must contain"):
            find_pictures(tmp_path, pattern)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.lists(st.text(max_size=8) | st.from_regex(r"[a-z]?[0-9]{1,3}[²٣a-z]?[0-9]?", fullmatch=True), unique=True))
def test_the_order_depends_on_the_names_only(names):
    ordered = in_order(names)
    assert sorted(ordered) == sorted(names)
    assert in_order(names[::-1]) == ordered


@given(st.lists(st.integers(0, 5000), unique=True))
def test_numbers_count(numbers):
    assert in_order([f"img{n}" for n in numbers]) == [f"img{n}" for n in sorted(numbers)]


# small files that unpack to huge pictures


def zeros_png(width: int, height: int, rows: int = 1) -> bytes:
    """A grey PNG that declares a size; so many of its rows are there."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    packed = zlib.compressobj()
    pixels = b"".join(packed.compress(bytes(width + 1)) for _ in range(rows)) + packed.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def tiff(width: int, height: int, order: str = "<", big: bool = False, **more: int) -> bytes:
    """The head of a TIFF; the size is there twice, the smaller one first."""
    tags = [(256, 4, 8), (256, 4, width), (257, 4, height), (277, 3, 1), *((int(k[1:]), 4, v) for k, v in more.items())]
    wide, count = ("Q", "Q") if big else ("I", "H")
    begin = (b"II" if order == "<" else b"MM") + struct.pack(
        order + ("HHHQ" if big else "HI"), *((43, 8, 0, 16) if big else (42, 8))
    )
    out = begin + struct.pack(order + count, len(tags))
    for tag, kind, value in tags:
        cell = struct.pack(order + ("H" if kind == 3 else "I"), value).ljust(8 if big else 4, b"\0")
        out += struct.pack(order + "HH" + wide, tag, kind, 1) + cell
    return out + bytes(64)


def with_size(jpeg: bytes, width: int, height: int) -> bytes:
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + struct.pack(">HH", height, width) + jpeg[at + 4 :]


def bombs() -> dict[str, bytes]:
    jpeg = cv2.imencode(".jpg", scene())[1].tobytes()
    huge = with_size(jpeg, 65_500, 65_500)
    hidden = jpeg_with(bytes(60_000), with_size(jpeg, 40_000, 40_000))
    for _ in range(5):  # beyond what a look at the beginning reads
        hidden = jpeg_with(bytes(60_000), hidden)
    return {
        "a.png": zeros_png(32_000, 32_000),
        "b.png": zeros_png(2**31 - 1, 2**31 - 1, rows=0),
        "c.jpg": huge,
        "d.jpg": hidden,
        "e.jpg": huge[:20] + b"rubbish" * 9 + huge[20:],  # between two segments, where decoders skip it
        "f.tif": tiff(32_000, 32_000),
        "g.tif": tiff(32_000, 32_000, ">", big=True),
        "h.tif": tiff(64, 48, t322=32_000, t323=32_000),  # a tile larger than the picture
        "i.tif": cv2.imencode(".tif", scene())[1]
        .tobytes()
        .replace(struct.pack("<HHII", 256, 3, 1, 64), struct.pack("<HHII", 256, 4, 1, 10**7)),
    }


def test_a_small_file_that_unpacks_to_a_huge_picture_is_refused_by_its_head(tmp_path, monkeypatch):
    """cases/png-bomb: a PNG of 1 MB cost 2 GiB and a minute."""
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was unpacked"))
    for name, content in bombs().items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ImageError, match="160 million pixels at most") as told:
            read_picture(tmp_path / name)
        assert name in told.value.what
        assert " x " in told.value.what


def test_what_cannot_be_measured_is_not_unpacked(tmp_path, monkeypatch):
    """OpenCV would read a WebP or a BMP under any name."""
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was unpacked"))
    for ending in (".bmp", ".webp"):
        (tmp_path / "a.png").write_bytes(cv2.imencode(ending, scene())[1].tobytes())
        with pytest.raises(ImageError, match="not a picture that can be read"):
            read_picture(tmp_path / "a.png")
    (tmp_path / "a.tif").write_bytes(tiff(64, 48)[:10])
    with pytest.raises(ImageError, match="damaged or cut off"):
        read_picture(tmp_path / "a.tif")


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("ending", [".png", ".tif", ".jpg"])
def test_a_head_says_what_the_decoder_makes(ending, channels):
    for image in (scene((30, 50), 8, channels), scene((30, 50), 16, channels)):
        if ending == ".jpg" and image.dtype != np.uint8:
            continue
        data = cv2.imencode(ending, image)[1]
        head, made = read_head(data.tobytes()), cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        assert (head.height, head.width) == made.shape[:2]
        assert head.channels >= (1 if made.ndim == 2 else made.shape[2])
        assert head.unpacking_bytes >= made.nbytes + 30 * 50 * 4


@settings(max_examples=300)
@given(st.sampled_from(["png", "jpg", "tif", "big"]), st.data())
def test_any_damage_to_a_head_is_refused_or_declared(kind, data):
    """Bytes changed anywhere in the first 300: what is decoded is never larger than its head said."""
    whole = tiff(8, 8, big=True) if kind == "big" else cv2.imencode(f".{kind}", scene((16, 16)))[1].tobytes()
    content = bytearray(whole)
    for at, value in data.draw(st.lists(st.tuples(st.integers(0, 299), st.integers(0, 255)), max_size=4)):
        content[at % len(content)] = value
    head = read_head(bytes(content))
    assert head is None or (head.width > 0 and head.height > 0)
    if head is not None and head.width * head.height < 10**6:
        with contextlib.suppress(cv2.error):
            made = cv2.imdecode(
                np.frombuffer(bytes(content), np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
            )
            if made is not None and bytes(content[:3]) in (b"\x89PN", b"\xff\xd8\xff", b"II*"):
                assert made.shape[0] * made.shape[1] <= head.width * head.height


def test_pictures_side_by_side_wait_for_room(tmp_path, monkeypatch):
    """Ten threads read pictures of which two fit at a time."""
    path = saved(tmp_path / "a.png", scene())
    room = images._Room(2 * read_head(path.read_bytes()).unpacking_bytes)
    monkeypatch.setattr(images, "_ROOM", room)
    inside, most, lock, decode = 0, 0, threading.Lock(), cv2.imdecode

    def counted(*words):
        nonlocal inside, most
        with lock:
            inside += 1
            most = max(most, inside)
        time.sleep(0.01)
        try:
            return decode(*words)
        finally:
            with lock:
                inside -= 1

    monkeypatch.setattr(cv2, "imdecode", counted)
    with ThreadPoolExecutor(10) as pool:
        assert all(grey.shape == (48, 64) for grey in pool.map(read_picture, [path] * 20))
    assert most == 2
    assert room._free == room.size
    monkeypatch.setattr(images, "_ROOM", images._Room(10))  # one that never fits is read alone
    assert read_picture(path).shape == (48, 64)


def test_films_are_measured_before_a_picture_is_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for i in range(3):
        writer.write(scene(channels=3, seed=i))
    writer.release()
    assert (Film.of(path).width, OpenCVCamera("left", path).frame().picture.shape) == (64, (48, 64))
    monkeypatch.setattr(images, "MAX_PIXELS", 64 * 48 - 1)
    with pytest.raises(ImageError, match="has 64 x 48 pixels"):
        Film.of(path)
    with pytest.raises(ImageError, match=r"camera left: .*a.avi has 64 x 48 pixels"):
        OpenCVCamera("left", path).open()

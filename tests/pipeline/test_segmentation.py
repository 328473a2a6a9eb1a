"""Segmenters: which classes are masked, what a photo's probability is, and what is refused with its reason.

torchvision and ai-edge-litert are stand-ins here: networks whose answers are known beforehand.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import write_tiny_scene

from pipeline.files import sha256_of
from pipeline.launch.tasks import in_process
from pipeline.masks import make_masks, read_masks
from pipeline.segmentation import SegmenterError, deeplabv3, find_segmenter, maskrcnn
from pipeline.segmentation import tflite as tflite_module
from pipeline.segmentation.classes import COCO_TRANSIENT, PASCAL, PASCAL_TRANSIENT
from pipeline.segmentation.tflite import TFLite, read_labels, softmax

PHOTOS = 3


@pytest.fixture
def root(tmp_path):
    return write_tiny_scene(tmp_path / "tiny", photos=PHOTOS)


# Which segmenter


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("deeplabv4", "did you mean 'deeplabv3'?"),
        ("deeplabv3:x", "not one of deeplabv3, maskrcnn, tflite:FILE, folder:DIR"),
        ("tflite", "tflite:FILE"),
        ("tflite:", "tflite:FILE"),
        ("", "not one of"),
    ],
)
def test_a_segmenter_that_is_not_known(words, part):
    with pytest.raises(SegmenterError, match=re.escape(part)):
        find_segmenter(words)


def test_nothing_that_stands_still_is_masked():
    still = {"bottle", "chair", "diningtable", "pottedplant", "sofa", "tvmonitor", "background"}
    assert set(PASCAL) - set(PASCAL_TRANSIENT) == still
    assert len(PASCAL) == 21
    street = {"traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "chair", "potted plant", "clock"}
    indoors = {"vase", "couch", "bed", "dining table", "toilet", "tv", "refrigerator", "sink", "oven", "book"}
    assert not (street | indoors) & set(COCO_TRANSIENT)
    assert {"person", "car", "bird", "elephant", "backpack", "skis", "tennis racket"} <= set(COCO_TRANSIENT)


# torchvision's networks, against a stand-in


COCO = (
    "__background__", "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat",
    "traffic light", "fire hydrant", "N/A", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse",
    "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "N/A", "backpack", "umbrella", "N/A", "N/A", "handbag",
    "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove",
    "skateboard", "surfboard", "tennis racket", "bottle", "chair", "cell phone", "clock", "vase",
)  # fmt: skip


class FakeDeepLab(torch.nn.Module):
    """Logits are the weights' own, plus 20 for the background where the photo is dark."""

    def __init__(self, classes: int):
        super().__init__()
        self.logits = torch.nn.Parameter(torch.zeros(classes))

    def forward(self, images):
        assert not self.training
        assert images.dtype == torch.float32
        dark = (images.mean(dim=1) < 0.5).float()
        logits = self.logits[None, :, None, None].repeat(1, 1, *dark.shape[1:])
        logits[:, 0] += 20 * dark
        return {"out": logits, "aux": torch.full_like(logits, torch.nan)}


class FakeMaskRCNN(torch.nn.Module):
    """Finds each of `labels` in a square of its own, with its score."""

    def __init__(self, classes: int):
        super().__init__()
        self.labels = torch.nn.Parameter(torch.zeros(3, dtype=torch.long), requires_grad=False)
        self.scores = torch.nn.Parameter(torch.zeros(3))

    def forward(self, images):
        assert not self.training
        (image,) = images
        assert image.dtype == torch.float32
        assert 0 <= image.min() <= image.max() <= 1
        _, height, width = image.shape
        masks = torch.zeros(3, 1, height, width)
        for i in range(3):
            masks[i, 0, :, i * 10 : i * 10 + 15] = 0.8  # 0-15, 10-25, 20-35: neighbours overlap
        return [{"labels": self.labels.data, "scores": self.scores, "masks": masks, "boxes": torch.zeros(3, 4)}]


@pytest.fixture
def vision(monkeypatch, tmp_path):
    """vision(state): a torchvision whose weights of both networks are `state`, in torch's cache already."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(torch.hub, "_hub_dir", None)
    for module in (deeplabv3, maskrcnn):
        module.load.cache_clear()

    def install(state, voc=PASCAL, coco=COCO):
        folder = tmp_path / "torch" / "hub" / "checkpoints"
        folder.mkdir(parents=True, exist_ok=True)
        torch.save(state, folder / "new")
        file = folder / f"weights-{sha256_of(folder / 'new')[:8]}.pth"
        (folder / "new").rename(file)

        def half(image):
            assert image.dtype == torch.uint8
            assert image.shape[0] == 3
            return image[:, ::2, ::2] / 255

        url = f"https://example.org/models/{file.name}"
        weights = {
            "deeplabv3_resnet101": SimpleNamespace(
                url=url, meta={"categories": ["__background__", *voc[1:]]}, transforms=lambda: half
            ),
            "maskrcnn_resnet50_fpn_v2": SimpleNamespace(
                url=url, meta={"categories": list(coco)}, transforms=lambda: lambda image: image / 255
            ),
        }
        networks = {"deeplabv3_resnet101": FakeDeepLab, "maskrcnn_resnet50_fpn_v2": FakeMaskRCNN}

        def get_model(name, *, weights, weights_backbone, num_classes, **sizes):
            assert weights is None  # nothing is downloaded behind our back
            assert weights_backbone is None
            assert sizes == ({"aux_loss": True} if "deeplab" in name else {})
            return networks[name](num_classes)

        fake = ModuleType("torchvision")
        fake.__version__ = "0.0-fake"
        fake.models = SimpleNamespace(
            get_model=get_model, get_model_weights=lambda name: SimpleNamespace(DEFAULT=weights[name])
        )
        monkeypatch.setitem(sys.modules, "torchvision", fake)
        return file

    yield install
    for module in (deeplabv3, maskrcnn):
        module.load.cache_clear()


LIGHT = np.full((20, 40, 3), 255, np.uint8)


def voc_state(probabilities: dict[str, float]) -> dict:
    """Weights under which a light photo has these probabilities, and the background the rest."""
    values = torch.tensor([probabilities.get(name, 1e-9) for name in PASCAL], dtype=torch.float64)
    values[0] = 1 - sum(probabilities.values())
    return {"logits": values.log().float()}


def test_deeplab_adds_the_transient_classes(vision):
    vision(voc_state({"person": 0.3, "dog": 0.2, "chair": 0.1, "tvmonitor": 0.05}))
    found = find_segmenter("deeplabv3").probability(None, LIGHT)
    assert found.shape == (10, 20)  # as the weights' own preprocessing says
    np.testing.assert_allclose(found, 0.5, atol=1e-4)


@pytest.mark.parametrize("name", PASCAL[1:])
def test_deeplab_class_by_class(vision, name):
    vision(voc_state({name: 0.9}))
    still = ("bottle", "chair", "diningtable", "pottedplant", "sofa", "tvmonitor")
    expected = 0.0 if name in still else 0.9
    np.testing.assert_allclose(find_segmenter("deeplabv3").probability(None, LIGHT), expected, atol=1e-4)


def test_deeplab_says_where(vision):
    vision(voc_state({"person": 0.9}))
    pixels = LIGHT.copy()
    pixels[:, 20:] = 0
    found = find_segmenter("deeplabv3").probability(None, pixels)
    np.testing.assert_allclose(found[:, :10], 0.9, atol=1e-4)
    np.testing.assert_allclose(found[:, 10:], 0.0, atol=1e-4)


def coco_state(**scores: float) -> dict:
    names = [name.replace("_", " ") for name in scores]
    return {
        "labels": torch.tensor([COCO.index(name) for name in names]),
        "scores": torch.tensor(list(scores.values())),
    }


def test_maskrcnn_takes_the_best_transient_detection(vision):
    vision(coco_state(person=0.5, bench=0.9, car=0.25))
    found = find_segmenter("maskrcnn").probability(None, LIGHT)
    assert found.shape == (20, 40)
    expected = np.zeros(40)
    expected[20:35] = 0.25 * 0.8
    expected[0:15] = 0.5 * 0.8
    np.testing.assert_allclose(found, np.tile(expected, (20, 1)), atol=1e-6)
    vision(coco_state(person=0.5, backpack=1.0, car=0.25))
    maskrcnn.load.cache_clear()
    expected[10:25] = 0.8  # where two overlap, the stronger one
    np.testing.assert_allclose(find_segmenter("maskrcnn").probability(None, LIGHT)[0], expected, atol=1e-6)


def test_maskrcnn_without_a_transient_thing_masks_nothing(vision):
    vision(coco_state(bench=1.0, clock=1.0, traffic_light=1.0))
    found = find_segmenter("maskrcnn").probability(None, LIGHT)
    assert (found.shape, found.dtype, found.max()) == ((20, 40), np.float32, 0)


def test_maskrcnn_sees_large_photos_reduced(vision):
    vision(coco_state(person=1.0, car=1.0, dog=1.0))
    assert find_segmenter("maskrcnn").probability(None, np.zeros((1000, 2666, 3), np.uint8)).shape == (500, 1333)


@pytest.mark.parametrize("name", ["deeplabv3", "maskrcnn"])
def test_a_network_of_torchvision_masks_a_scene(vision, root, name):
    file = vision(voc_state({"person": 0.5}) if name == "deeplabv3" else coco_state(person=0.5, dog=0.5, bench=1.0))
    made = make_masks(root, find_segmenter(name), mapper=in_process)
    assert made.made == PHOTOS
    assert 0 < made.share < 0.5
    record = read_masks(root / "masks").segmenter
    assert (record.name, record.file, record.sha256) == (name, file.name, sha256_of(file))
    assert record.versions == {"torch": torch.__version__, "torchvision": "0.0-fake"}
    assert record.classes["person"] == (15 if name == "deeplabv3" else 1)
    assert make_masks(root, find_segmenter(name), mapper=in_process).made == 0


def test_a_network_without_a_class_is_refused(vision):
    vision(voc_state({}), voc=[name for name in PASCAL if name != "sheep"])
    with pytest.raises(SegmenterError, match="deeplabv3_resnet101 has no class sheep"):
        find_segmenter("deeplabv3").describe(())


@pytest.mark.parametrize("name", ["deeplabv3", "maskrcnn"])
def test_without_torchvision_it_says_how_to_get_it(monkeypatch, name, root):
    monkeypatch.setitem(sys.modules, "torchvision", None)  # what an import of it meets where it is not installed
    with pytest.raises(SegmenterError, match=re.escape("pip install -e '.[torchvision]'")):
        make_masks(root, find_segmenter(name), mapper=in_process)
    assert not (root / "masks").exists()


def test_a_torchvision_for_another_torch_is_told_apart(monkeypatch, tmp_path):
    (tmp_path / "torchvision.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SegmenterError, match=r"does not run beside torch 2.*nms does not exist.*belong together"):
        find_segmenter("deeplabv3").describe(())


def test_weights_that_cannot_be_downloaded(vision, monkeypatch):
    from urllib.error import URLError

    file = vision(voc_state({}))
    file.unlink()

    def offline(url, path, promised, progress):
        assert (url, path, progress) == (f"https://example.org/models/{file.name}", str(file), False)
        assert file.name == f"weights-{promised}.pth"
        raise URLError("no route to host")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    with pytest.raises(SegmenterError, match=rf"{file.name} cannot be downloaded.*no route.*put it at {file}"):
        find_segmenter("deeplabv3").describe(())


def test_weights_that_are_damaged(vision):
    file = vision(voc_state({}))
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(SegmenterError, match=rf"{file} is damaged"):
        find_segmenter("deeplabv3").describe(())


def test_weights_run_no_code(vision, tmp_path):
    class Attack:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    vision({"logits": Attack()})
    with pytest.raises(SegmenterError, match="cannot be read as the weights of deeplabv3_resnet101"):
        find_segmenter("deeplabv3").probability(None, LIGHT)
    assert not (tmp_path / "owned").exists()


def test_weights_of_another_network(vision):
    vision({"other": torch.zeros(3)})
    with pytest.raises(SegmenterError, match="cannot be read as the weights of deeplabv3_resnet101"):
        find_segmenter("deeplabv3").probability(None, LIGHT)


# TFLite models, against a stand-in


class FakeInterpreter:
    """Takes 4 x 5 pixels, and thinks that what is red is a person and what is green a sofa."""

    taken: tuple = (1, 4, 5, 3)
    given: tuple = (1, 4, 5, 21)
    dtype: type = np.float32
    labels: tuple = PASCAL

    def __init__(self, path, num_threads, experimental_op_resolver_type):
        assert num_threads == 1
        if Path(path).read_bytes() != b"model":
            raise ValueError("not a valid Flatbuffer buffer")

    def allocate_tensors(self):
        pass

    def get_input_details(self):
        return [{"index": 0, "shape": np.array(self.taken), "dtype": self.dtype}]

    def get_output_details(self):
        return [{"index": 1, "shape": np.array(self.given), "dtype": self.dtype}]

    def set_tensor(self, index, value):
        assert (index, value.shape, value.dtype) == (0, self.taken, np.float32)
        self.value = value

    def invoke(self):
        assert self.value.min() >= -1
        assert self.value.max() <= 1

    def get_tensor(self, index):
        assert index == 1
        logits = np.zeros(self.given, np.float32)
        for name, channel in (("person", 0), ("sofa", 1)):
            logits[..., self.labels.index(name)] = 30 * self.value[..., channel]
        return logits


@pytest.fixture
def model(monkeypatch, tmp_path):
    """A file that the stand-in for ai-edge-litert takes for a model."""
    fake = ModuleType("ai_edge_litert.interpreter")
    fake.Interpreter = FakeInterpreter
    fake.OpResolverType = SimpleNamespace(AUTO=0, BUILTIN_WITHOUT_DEFAULT_DELEGATES=3)
    monkeypatch.setitem(sys.modules, "ai_edge_litert", ModuleType("ai_edge_litert"))
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", fake)
    tflite_module.load.cache_clear()
    file = tmp_path / "model.tflite"
    file.write_bytes(b"model")
    yield file
    tflite_module.load.cache_clear()


def half_red() -> np.ndarray:
    """Red on the left, green on the right."""
    pixels = np.zeros((20, 40, 3), np.uint8)
    pixels[:, :24, 0] = 255
    pixels[:, 24:, 1] = 255
    return pixels


def test_a_tflite_model_gets_the_whole_photo_squeezed(model):
    found = TFLite(model).probability(None, half_red())
    assert found.shape == (4, 5)
    np.testing.assert_allclose(found[:, :3], 1, atol=1e-6)  # person, where it is red
    np.testing.assert_allclose(found[:, 3:], 0, atol=1e-6)  # sofa, where it is green


def test_labels_beside_the_model_say_which_channel_is_what(model, monkeypatch):
    labels = (*PASCAL[15:], *PASCAL[:15])
    model.with_suffix(".txt").write_text("\n".join(labels) + "\n\n")
    monkeypatch.setattr(FakeInterpreter, "labels", labels)
    np.testing.assert_allclose(TFLite(model).probability(None, half_red())[0], [1, 1, 1, 0, 0], atol=1e-6)


def test_labels_are_read_in_any_spelling_and_other_classes_are_refused(tmp_path):
    file = tmp_path / "m.tflite"
    assert read_labels(file) == list(PASCAL)
    spelt = {
        "bicycle": "biyclce",
        "diningtable": "Dining table",
        "tvmonitor": "tv-monitor",
        "background": "__background__",
    }
    (tmp_path / "m.txt").write_text("\r\n".join(spelt.get(name, name) for name in PASCAL))
    assert read_labels(file) == list(PASCAL)
    (tmp_path / "m.txt").write_text("\n".join(PASCAL[:20]))
    with pytest.raises(SegmenterError, match=r"m.txt does not name PASCAL VOC's 21 classes.*it has 20 lines"):
        read_labels(file)
    (tmp_path / "m.txt").write_text("\n".join((*PASCAL[:20], "street light")))
    with pytest.raises(SegmenterError, match="it has street light"):
        read_labels(file)
    (tmp_path / "m.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SegmenterError, match=r"m.txt cannot be read"):
        read_labels(file)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"taken": (1, 4, 5, 1)}, "takes float32 1 x 4 x 5 x 1"),
        ({"taken": (2, 4, 5, 3)}, "takes float32 2 x 4 x 5 x 3"),
        ({"given": (1, 4, 5, 150)}, "gives float32 1 x 4 x 5 x 150"),
        ({"given": (1, 21)}, "gives float32 1 x 21"),
        ({"dtype": np.uint8}, "takes uint8 1 x 4 x 5 x 3"),
    ],
)
def test_a_model_of_other_shapes_is_refused_with_them(model, monkeypatch, change, part):
    for name, value in change.items():
        monkeypatch.setattr(FakeInterpreter, name, value)
    with pytest.raises(SegmenterError, match=rf"model.tflite .*{part}.*what we can use"):
        TFLite(model).describe(())


def test_a_file_that_is_no_model(model):
    model.write_bytes(b"something else")
    with pytest.raises(SegmenterError, match=r"model.tflite cannot be read as a TFLite model"):
        TFLite(model).describe(())
    with pytest.raises(SegmenterError, match=r"absent.tflite: no such file"):
        TFLite(model.with_name("absent.tflite")).describe(())


def test_without_litert_it_says_how_to_get_it(monkeypatch, model):
    monkeypatch.setitem(sys.modules, "ai_edge_litert", None)
    monkeypatch.delitem(sys.modules, "ai_edge_litert.interpreter")
    with pytest.raises(SegmenterError, match=re.escape("pip install -e '.[tflite]'")):
        TFLite(model).describe(())


def test_softmax_of_large_logits():
    np.testing.assert_allclose(softmax(np.array([[1000.0, 1000.0], [0.0, np.log(3.0)]])), [[0.5, 0.5], [0.25, 0.75]])


# The real network


@pytest.mark.real
def test_a_real_probability_is_the_softmax_of_the_networks_logits(test_data):
    pytest.importorskip("ai_edge_litert", reason="the tflite extra is not installed")
    from ai_edge_litert.interpreter import Interpreter

    network = test_data / "segmentation" / "deeplabv3_257_mv_gpu.tflite"
    with Image.open(test_data / "reichstag" / "dense" / "images" / "48542127_4157749181.jpg") as image:
        photo = np.asarray(image)
        squeezed = np.asarray(image.resize((257, 257), Image.Resampling.BILINEAR))
    model = Interpreter(str(network))
    model.allocate_tensors()
    model.set_tensor(model.get_input_details()[0]["index"], np.float32(squeezed[None] / 255.0 * 2 - 1))
    model.invoke()
    logits = torch.from_numpy(model.get_tensor(model.get_output_details()[0]["index"])[0])
    still = [PASCAL.index(name) for name in PASCAL if name not in PASCAL_TRANSIENT]
    expected = 1 - logits.softmax(dim=-1)[..., still].sum(dim=-1)
    np.testing.assert_allclose(TFLite(network).probability(None, photo), expected, atol=1e-4)


@pytest.mark.real
def test_a_cut_off_tflite_model_is_refused(test_data, tmp_path):
    pytest.importorskip("ai_edge_litert", reason="the tflite extra is not installed")
    whole = (test_data / "segmentation" / "deeplabv3_257_mv_gpu.tflite").read_bytes()
    (tmp_path / "cut.tflite").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SegmenterError, match=r"cut.tflite cannot be read"):
        TFLite(tmp_path / "cut.tflite").describe(())

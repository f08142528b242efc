import json
from pathlib import Path

import numpy as np
import pytest

from warmprior.data.convert import quietly

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

WIDTHS = {"observation.environment_state": 10, "observation.state": 9, "action": 7}
"""Those of lift."""


def numbers(width, names=None):
    return {"dtype": "float32", "shape": (width,), "names": names}


def pictures(kind, side=32):
    return {"dtype": kind, "shape": (side, side, 3), "names": ["height", "width", "channels"]}


def scene(episode, step, side=32):
    """An image that tells its place, and which way is up."""
    image = np.full((side, side, 3), 60 * episode + 5 * step, np.uint8)
    image[: side // 2] += 40
    image[..., 2] = 200
    return image


def looks_at_one_column(features, name, feature):
    """Set a column of a dataset; its package looks at all of them again, which are hundreds of statistics."""
    from datasets.features.features import require_decoding

    dict.__setitem__(features, name, feature)
    features._column_requires_decoding[name] = require_decoding(feature)


def write_lerobot(
    root, lengths=(6, 1, 9), features=None, images=(), fps=20, seed=0, resting=(), same=(), **options
):
    """Write random episodes with LeRobot, and return the values of all steps by feature.

    The last number of features that are resting never changes. Those that are the same have the values of the
    feature before them.
    """
    from datasets import Features
    from lerobot.datasets import LeRobotDataset

    Features.__setitem__ = looks_at_one_column  # for the rest of this process
    features = features or {name: numbers(width) for name, width in WIDTHS.items()}
    cameras = {f"observation.images.{name}": pictures(kind) for name, kind in images}
    dataset = LeRobotDataset.create(
        "local/test",
        fps,
        features | cameras,
        root=root,
        use_videos=any(kind == "video" for _, kind in images),
        **options,
    )
    rng, written = np.random.default_rng(seed), {name: [] for name in features}
    for episode, steps in enumerate(lengths):
        for step in range(steps):
            frame = {}
            for name, feature in features.items():
                value = rng.normal(size=feature["shape"])
                value = value > 0 if feature["dtype"] == "bool" else value.astype(feature["dtype"])
                value[-1] = 0.5 if name in resting else value[-1]
                frame[name] = list(frame.values())[-1] if name in same else value
                written[name].append(frame[name])
            frame |= {name: scene(episode, step) for name in cameras}
            dataset.add_frame(frame | {"task": "lift"})
        with quietly():
            dataset.save_episode()
    dataset.finalize()
    return {name: np.stack(values) for name, values in written.items()}


def edit_json(path: Path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_table(path: Path, **columns):
    """Replace columns of a parquet file by functions of their values; one row group is written."""
    table = pq.read_table(path)
    for name, change in columns.items():
        name = name.replace("__", ".").replace("SLASH", "/")
        place = table.schema.get_field_index(name)
        column = pa.array(change(table[name].to_pylist()), table.schema.field(place).type)
        table = table.set_column(place, name, column)
    pq.write_table(table, path)

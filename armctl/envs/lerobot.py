"""LeRobotWriter: episodes as a data set in the format LeRobotDataset v3.0, without the package lerobot.

The format keeps numbers in Parquet, pictures in films, and says in `meta/` where each episode is in these files. Files grow up
to a size and are numbered in chunks of a thousand.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import import_extra
from armctl.report.render.renderer import Image
from armctl.report.render.video import Mp4Writer

VERSION = "v3.0"
FRONT = "observation.images.front"  # the film of the render mode
_CHUNK_SIZE = 1000  # files in a folder
_DATA_FILE_MB = 100
_VIDEO_FILE_MB = 200
_MB = 2**20
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA_PATH = f"data/{_FILE}.parquet"
_VIDEO_PATH = f"videos/{{video_key}}/{_FILE}.mp4"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_KEYFRAME_INTERVAL = 2  # frames: training reads single frames
_STATISTICS_FRAMES = 10  # one of so many frames counts in the statistics of pictures, ...
_STATISTICS_PIXELS = 4  # ... and one of so many rows and columns
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_INDICES = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"}

Statistics = dict[str, NDArray[Any]]


class Feature(NamedTuple):
    """A quantity of each frame."""

    dtype: str  # "float32", "int64" or "bool"
    names: Sequence[str] | None = None  # of its numbers; None for a single number

    def info(self) -> dict[str, Any]:
        return {
            "dtype": self.dtype,
            "shape": [len(self.names or [""])],
            "names": None if self.names is None else list(self.names),
        }


def film_name(camera: str) -> str:
    """What the film of a camera is called."""
    return f"observation.images.{camera}"


class _CameraFilm:
    """The pictures of one camera, in files that grow up to a size."""

    def __init__(self, folder: Path, name: str, rate: int, size: tuple[int, int]):
        self._folder = folder
        self._name = name
        self._rate = rate
        self.size = size
        self._video: Mp4Writer | None = None
        self._path = folder
        self._files = 0
        self._frames = 0

    def close(self) -> None:
        if self._video is not None:
            self._video.close()
            self._video = None

    def add(self, images: Iterable[Image]) -> tuple[dict[str, Any], Statistics]:
        """Writes the pictures of an episode; returns where they are, and their statistics."""
        if self._video is not None and self._path.stat().st_size >= _VIDEO_FILE_MB * _MB:
            self.close()
        if self._video is None:
            self._path = new_file(self._folder, _VIDEO_PATH.format(video_key=self._name, **_numbered(self._files)))
            self._files += 1
            self._frames = 0
            self._video = Mp4Writer(self._path, self._rate, self.size, keyframe_interval=_KEYFRAME_INTERVAL)
        first = self._frames
        sampled = []
        for count, image in enumerate(images):
            self._video.add(image)
            self._frames += 1
            if count % _STATISTICS_FRAMES == 0:
                sampled.append(image[::_STATISTICS_PIXELS, ::_STATISTICS_PIXELS].reshape(-1, 3) / 255.0)
        pixels = _statistics(np.concatenate(sampled))
        statistics = {what: v if what == "count" else v.reshape(3, 1, 1) for what, v in pixels.items()}
        statistics["count"] = np.array([len(sampled)])
        place = {f"videos/{self._name}/{name}": number for name, number in _numbered(self._files - 1).items()}
        times = {"from_timestamp": first / self._rate, "to_timestamp": self._frames / self._rate}
        return {**place, **{f"videos/{self._name}/{name}": time for name, time in times.items()}}, statistics

    def info(self) -> dict[str, Any]:
        width, height = self.size
        return {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": self._rate,
                "video.channels": 3,
                "has_audio": False,
            },
        }


class LeRobotWriter:
    """Writes a data set episode by episode; `finish` writes what describes it."""

    def __init__(
        self,
        folder: Path,
        *,
        frames_per_second: int,
        robot: str,
        features: Mapping[str, Feature],
        films: Mapping[str, tuple[int, int]],
    ):
        """A data set without episodes in an existing folder; `films` has the size of the pictures of each film by its name.

        NotInstalledError if packages for Parquet or films are missing.
        """
        for package in ("pandas", "pyarrow"):
            import_extra(package, "data sets need pyarrow and pandas", "study")
        if films:
            import_extra("av", "films of episodes need an encoder", "view")
        self.episodes = 0  # episodes so far
        self.frames = 0  # frames so far
        self._folder = folder
        self._rate = frames_per_second
        self._robot = robot
        self._features = {**features, **{name: Feature(dtype) for name, dtype in _INDICES.items()}}
        self._films = {name: _CameraFilm(folder, name, frames_per_second, size) for name, size in films.items()}
        self._tasks: list[str] = []
        self._rows: list[dict[str, Any]] = []
        self._statistics: list[dict[str, Statistics]] = []
        self._data: Any = None
        self._data_path = folder
        self._data_files = 0

    def add(self, task: str, values: Mapping[str, NDArray[Any]], images: Mapping[str, Iterable[Image]]) -> None:
        """Adds an episode of a task, in words: values (k, size) or (k,) of each feature, and k pictures of each film."""
        if task not in self._tasks:
            self._tasks.append(task)
        length = len(next(iter(values.values())))
        frames = np.arange(length)
        columns = {
            **values,
            "timestamp": (frames / self._rate).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(length, self.episodes),
            "index": self.frames + frames,
            "task_index": np.full(length, self._tasks.index(task)),
        }
        statistics = {name: _statistics(np.asarray(columns[name])) for name in self._features}
        row: dict[str, Any] = {"episode_index": self.episodes, "tasks": [task], "length": length}
        row |= self._add_data(columns)
        for name, film in self._films.items():
            place, statistics[name] = film.add(images[name])
            row |= place
        row |= {f"stats/{name}/{what}": v.tolist() for name, each in statistics.items() for what, v in each.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self._rows.append(row)
        self._statistics.append(statistics)
        self.episodes += 1
        self.frames += length

    def finish(self) -> None:
        """Closes the files and writes what describes the data set."""
        import pandas as pd
        import pyarrow as pa
        import pyarrow.parquet as pq

        self.close()
        episodes = self._folder / _EPISODES_PATH
        episodes.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._rows), episodes)
        tasks = pd.DataFrame({"task_index": range(len(self._tasks))}, index=pd.Index(self._tasks, name="task"))
        tasks.to_parquet(self._folder / "meta/tasks.parquet")
        merged = {name: _merged([each[name] for each in self._statistics]) for name in self._statistics[0]}
        self._write_json("stats.json", {name: {what: v.tolist() for what, v in each.items()} for name, each in merged.items()})
        self._write_json("info.json", self._info())

    def close(self) -> None:
        if self._data is not None:
            self._data.close()
            self._data = None
        for film in self._films.values():
            film.close()

    def _add_data(self, columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """Writes the numbers of an episode; returns where they are."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        arrays = {name: _arrow(np.asarray(columns[name], feature.dtype), feature) for name, feature in self._features.items()}
        table = pa.table(arrays)
        if self._data is not None and self._data_path.stat().st_size >= _DATA_FILE_MB * _MB:
            self._data.close()
            self._data = None
        if self._data is None:
            self._data_path = new_file(self._folder, _DATA_PATH.format(**_numbered(self._data_files)))
            self._data_files += 1
            self._data = pq.ParquetWriter(self._data_path, table.schema, compression="snappy")
        self._data.write_table(table)
        where = _numbered(self._data_files - 1)
        first = self.frames
        place = {f"data/{name}": number for name, number in where.items()}
        return {**place, "dataset_from_index": first, "dataset_to_index": first + len(table)}

    def _info(self) -> dict[str, Any]:
        features = {name: feature.info() for name, feature in self._features.items()}
        features |= {name: film.info() for name, film in self._films.items()}
        return {
            "codebase_version": VERSION,
            "robot_type": self._robot,
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK_SIZE,
            "data_files_size_in_mb": _DATA_FILE_MB,
            "video_files_size_in_mb": _VIDEO_FILE_MB,
            "fps": self._rate,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": _DATA_PATH,
            "video_path": _VIDEO_PATH if self._films else None,
            "features": features,
        }

    def _write_json(self, name: str, content: object) -> None:
        (self._folder / "meta" / name).write_text(json.dumps(content, indent=4), encoding="utf-8")


def new_file(folder: Path, name: str) -> Path:
    """The path of a file in a data set, whose folder is made."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _numbered(number: int) -> dict[str, int]:
    """Chunk and place in it of a file."""
    return {"chunk_index": number // _CHUNK_SIZE, "file_index": number % _CHUNK_SIZE}


def _arrow(values: NDArray[Any], feature: Feature) -> Any:
    """A column of Parquet: lists of a fixed size, or numbers, which the format also has instead of lists of one."""
    import pyarrow as pa

    flat = pa.array(values.ravel())
    size = feature.info()["shape"][0]
    return flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)


def _statistics(values: NDArray[Any]) -> Statistics:
    """The statistics (size,) of values (k, size) or (k,)."""
    columns = values.reshape(len(values), -1)
    quantiles = np.quantile(columns.astype(np.float64), list(_QUANTILES.values()), axis=0)
    return {
        "min": columns.min(axis=0),
        "max": columns.max(axis=0),
        "mean": columns.mean(axis=0, dtype=np.float64),
        "std": columns.std(axis=0, dtype=np.float64),
        "count": np.array([len(columns)]),
        **dict(zip(_QUANTILES, quantiles, strict=True)),
    }


def _merged(parts: Sequence[Statistics]) -> Statistics:
    """The statistics of everything from those of episodes; quantiles are means of theirs, as lerobot merges them."""
    counts = np.array([part["count"][0] for part in parts], dtype=float)
    shares = (counts / counts.sum()).reshape(-1, *np.ones(parts[0]["mean"].ndim, int))
    means = np.array([part["mean"] for part in parts])
    mean = (shares * means).sum(axis=0)
    variance = (shares * (np.array([part["std"] for part in parts]) ** 2 + (means - mean) ** 2)).sum(axis=0)
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": np.array([int(counts.sum())]),
        **{name: (shares * np.array([part[name] for part in parts])).sum(axis=0) for name in _QUANTILES},
    }

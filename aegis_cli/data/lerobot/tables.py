"""The dataset's rows as parquet files, with the types that pandas and `datasets` expect."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from aegis_cli.common import files
from aegis_cli.data.lerobot import layout


class Sink:
    """A parquet file that tables are appended to.

    Each table is its own row group, so that an episode can be read separately.
    """

    def __init__(self, path: Path) -> None:
        import pyarrow as pa

        # The file is opened here and not by the writer, so that `size` can query its position.
        self._file, self._writer = pa.OSFile(str(path), "wb"), None

    def write(self, table: Any) -> None:
        """Append a table; the first one determines the columns."""
        from pyarrow import parquet

        if self._writer is None:
            self._writer = parquet.ParquetWriter(
                self._file, table.schema, compression="snappy", write_page_checksum=True
            )
        self._writer.write_table(table, row_group_size=len(table))

    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell()

    def close(self) -> None:
        """Write the footer, without which a parquet file cannot be read, and close the file."""
        if self._writer is not None:
            self._writer.close()
        self._file.close()


def of_frames(vectors: Mapping[str, np.ndarray], pictures: Mapping[str, Sequence[bytes]]) -> Any:
    """An episode's table: vectors [T, D] as lists, [T] and [T, 1] as numbers, pictures as bytes."""
    import pyarrow as pa

    # The common columns come last, as in LeRobot's own files.
    columns = {
        name: _vector(rows) for name, rows in vectors.items() if name not in layout.INDEX_FEATURES
    }
    for camera, images in pictures.items():
        names = [f"frame-{i:06d}.png" for i in range(len(images))]
        parts = [pa.array(images, pa.binary()), pa.array(names, pa.string())]
        columns[camera] = pa.StructArray.from_arrays(parts, ["bytes", "path"])
    for name, kind in layout.INDEX_FEATURES.items():
        columns[name] = pa.array(vectors[name].astype(kind))
    table = pa.table(columns)
    # This tells `datasets` which columns are images; Arrow's types do not show it.
    features = {field.name: _hf_feature(field.type) for field in table.schema}
    described = json.dumps({"info": {"features": features}})
    return table.replace_schema_metadata({"huggingface": described})


def _vector(rows: np.ndarray) -> Any:
    """Rows [T, D] as lists of D numbers, or as numbers if D is 1, as in LeRobot."""
    import pyarrow as pa

    flat, width = pa.array(rows.astype(np.float32).ravel()), rows.shape[1]
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def _hf_feature(kind: Any) -> dict[str, Any]:
    """The description of an Arrow type for `datasets`."""
    import pyarrow as pa

    if pa.types.is_struct(kind):
        return {"_type": "Image"}
    if pa.types.is_fixed_size_list(kind):
        return {
            "feature": {"dtype": "float32", "_type": "Value"},
            "length": kind.list_size,
            "_type": "Sequence",
        }
    name = "float32" if str(kind) == "float" else str(kind)  # Arrow calls it float
    return {"dtype": name, "_type": "Value"}


def of_rows(rows: Sequence[Mapping[str, Any]]) -> Any:
    """A table of rows that have the same keys."""
    import pyarrow as pa

    return pa.table({name: [row[name] for row in rows] for name in rows[0]})


def save_tasks(path: Path, tasks: Sequence[str]) -> None:
    """The texts as pandas writes them: `task` is the table's index, `task_index` its column."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table(
        {
            "task_index": pa.array(range(len(tasks)), pa.int64()),
            "task": pa.array(tasks, pa.string()),
        }
    )
    described = [
        _pandas_column("task_index", "int64", "int64"),
        _pandas_column("task", "unicode", "object"),
    ]
    # The metadata that pandas itself writes for such a frame, and uses to restore the index.
    header = {
        **_pandas_column("", "unicode", "object"),
        "name": None,
        "field_name": None,
        "metadata": {"encoding": "UTF-8"},
    }
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [header],
        "columns": described,
        "pandas_version": "2.0.0",
    }
    described_table = table.replace_schema_metadata({"pandas": json.dumps(pandas)})

    def write(file: BinaryIO) -> None:
        parquet.write_table(described_table, file, write_page_checksum=True)

    files.write_atomically(path, write)


def _pandas_column(name: str, kind: str, numpy_type: str) -> dict[str, Any]:
    """The description of a column for pandas."""
    return {
        "name": name,
        "field_name": name,
        "pandas_type": kind,
        "numpy_type": numpy_type,
        "metadata": None,
    }

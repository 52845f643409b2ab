"""Run many independent pieces of a study on both cores; what is done stays done when the study is stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import pandas as pd
from tqdm import tqdm

CACHE = Path(__file__).parent / ".cache"


def run_chunks(name: str, work: Callable[[int], pd.DataFrame], seeds: Sequence[int], jobs: int) -> pd.DataFrame:
    """Rows of `work(seed)` for all seeds, each kept as CSV under .cache/NAME until that folder is removed.

    RuntimeError in the end where any of them failed; the others are kept.
    """
    folder = CACHE / name
    folder.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not _chunk_file(folder, seed).exists()]
    failed: dict[int, BaseException] = {}
    with ProcessPoolExecutor(jobs) as pool:
        futures = {pool.submit(work, seed): seed for seed in missing}
        for future in tqdm(as_completed(futures), total=len(missing), desc=name):
            error = future.exception()
            if error is not None:
                failed[futures[future]] = error
                continue
            part = folder / "part"
            future.result().to_csv(part, index=False)
            part.replace(_chunk_file(folder, futures[future]))
    if failed:
        seed, error = next(iter(failed.items()))
        raise RuntimeError(f"{name}: {len(failed)} seeds failed, the first is {seed}") from error
    return pd.concat([pd.read_csv(_chunk_file(folder, seed)) for seed in seeds], ignore_index=True)


def _chunk_file(folder: Path, seed: int) -> Path:
    return folder / f"{seed:05d}.csv"

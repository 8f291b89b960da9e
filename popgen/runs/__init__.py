"""Operations of a run: folder, ledger, checkpoints, storage, recorder, monitoring, recovery."""

"""MAPPO on RLlib's new API stack, with the cross-play and mixed play of LIPO and CoMeDi."""

"""As little as shows what a recomputation does."""

from armctl.papers.verdict import Effort

SHORT = Effort(grid_seeds=1, pose_seeds=6, random_poses=20, samples=500, rounds=0, repeats=1)

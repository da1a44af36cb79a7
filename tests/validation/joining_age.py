"""How much a late box is still worth: the parameters of `sortie.perception.joining.LATENESS`, fitted on calibration towns.

The plan, committed before anything was measured:

- Model. A box of age a is off by a normal error along each axis, with variance sigma0² where the car stands and
  sigma0² + (speed · a)² where it moves; a share `moving` of the cars moves. A box counts (IoU 0.5) while it is off by less
  than r = √(length · width) / 3: a shift along a car reaches IoU 0.5 at a third of its length, one across it at a third of
  its width, and r is their geometric mean. So a box of age a is right, relative to a fresh one, with probability
  F(a) = ((1 − moving) · P(0) + moving · P(a)) / P(0), with P(a) = 1 − exp(−r² / (2 σ²(a))).
- Fit. Maximum likelihood of `speed`, `moving` and `sigma0` on single drones' boxes: whether a box found at t is still
  right (its best free truth, IoU ≥ 0.5) at t + a, among those that were right at t. Towns of the calibration's `fit` split;
  ages 0.1 … 2 s; the surrogate's boxes, all moments from fixed draws. No town of the library, of a set of conditions
  or of the `held-out` split is in it.
- Check, with the parameters fixed: on the `held-out` split, AP of every rung at every age against leaving it out.
"""

from __future__ import annotations

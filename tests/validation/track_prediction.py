"""What it is worth that receivers move late boxes and tracks to their own time (`make figures FIGURE=track_prediction`).

The plan, committed before anything was measured:

- Flights. `track_target` for 24 s in eight towns, 61 … 68, with as many seeds. The trackers' constants were chosen in
  towns 7, 8 and 9, the model of lateness in the calibration's towns; none of the eight is in either. Surrogate detector.
- Exchange. From 4 s on, twice a second, each of the five drones fuses its own look and one payload of each peer, all of one
  age: 0.1, 0.2, 0.5, 1 or 2 s. Its own look is of that moment. Nothing is sent by radio. Every drone's tracker takes in its own detections at 10, and the
  default 2, looks a second.
- Arms. Alone; the peers' detections where they were; the peers' detections moved by the receiver's own tracks; the peers'
  tracks where they were; the peers' tracks moved by their own velocity. What is not moved is weighed by its age
  (`sortie.perception.lateness`), as before there were tracks. Both rules of `perception.join`.
- Figures. AP@0.5 of the full scene by town; a gain is the mean of the towns' own differences from the same payloads not
  moved, with Student's interval over towns. HOTA of the boxes after fusion, by a tracker over them, for the default join.
- Expected: nothing at 0.1 s, and at 1 s a gain of detections and of tracks whose intervals lie above zero.
"""

from __future__ import annotations

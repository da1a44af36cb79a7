"""Playback in Rerun: saved, followed live, as a picture; of a sortie, of several, of a training."""

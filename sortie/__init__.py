"""Sortie simulates fleets of drones that share what they see: context, policy, real bytes and accuracy on one clock."""

"""Where every drone is and what flying costs at the rotors: formation, route, motion and viewpoints."""

"""Records in words: a simulation's answer and story in several languages, warnings and names in English."""

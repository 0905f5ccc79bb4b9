"""Physics twin in MuJoCo: two hands, a table and tasks, as a world and a source of episodes."""

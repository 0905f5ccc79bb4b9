"""Rating of rollouts by people: rubrics, marks, and agreement between raters."""

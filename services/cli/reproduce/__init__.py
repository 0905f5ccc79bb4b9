"""The paper's tables in miniature: their steps, a resumable runner, and the pages it writes."""

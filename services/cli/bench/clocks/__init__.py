"""The stage `clocks`: device clocks against simulated truth, beside their rivals."""

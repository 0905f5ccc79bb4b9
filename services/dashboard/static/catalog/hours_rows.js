// Hours of one field as rows of bars: shares of a common scale. No DOM here.

const PARTS = ["accepted", "not_reviewed", "rejected"];

// Tasks with a goal have a row even before their first episode.
export function withGoals(rows, goals) {
  const there = new Set(rows.map((row) => row.value));
  const none = { num_episodes: 0, accepted_h: 0, not_reviewed_h: 0, rejected_h: 0 };
  const missing = Object.keys(goals).filter((task) => !there.has(task)).sort().map((value) => ({ value, ...none }));
  return [...rows, ...missing].map((row) => ({ ...row, goal_h: goals[row.value] ?? null }));
}

// What may be trained on counts towards a goal: all but what was rejected.
export function counted(row) {
  return row.accepted_h + row.not_reviewed_h;
}

export function bars(rows) {
  const total = (row) => counted(row) + row.rejected_h;
  const longest_h = Math.max(...rows.map((row) => Math.max(total(row), row.goal_h ?? 0)), 0) || 1;
  return rows.map((row) => ({
    parts: PARTS.map((part) => ({ part, share: row[`${part}_h`] / longest_h })),
    goal: row.goal_h ? row.goal_h / longest_h : null,
    reached: row.goal_h ? counted(row) / row.goal_h : null,
    total_h: total(row),
  }));
}

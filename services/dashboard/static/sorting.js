// Stable sorting of table rows by any value; missing values come last in either direction.

export function sorted(rows, valueOf, descending) {
  const sign = descending ? -1 : 1;
  const keyed = rows.map((row, index) => ({ row, index, value: valueOf(row) }));
  keyed.sort((a, b) => {
    const [none_a, none_b] = [a.value ?? null, b.value ?? null].map((value) => value === null);
    if (none_a || none_b) return none_a - none_b || a.index - b.index;
    const order = typeof a.value === "string" ? a.value.localeCompare(b.value) : a.value - b.value;
    return sign * order || a.index - b.index;
  });
  return keyed.map(({ row }) => row);
}

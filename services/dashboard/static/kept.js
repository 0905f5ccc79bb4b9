// What this browser keeps for a page. One that keeps nothing (private windows, a full disk) begins anew, and works.

export function kept(name, storage = "localStorage") {
  try {
    return window[storage].getItem(name);
  } catch {
    return null;
  }
}

// Null forgets it.
export function keep(name, text, storage = "localStorage") {
  try {
    if (text === null) window[storage].removeItem(name);
    else window[storage].setItem(name, text);
  } catch {
    // It lasts as long as the page.
  }
}

/** A view as the part of an address after #, so that a link shows it again. */

/** @returns {Record<string, string>} what the address says */
export function readLink() {
  return Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
}

/**
 * Put what is shown into the address, without a new entry in the history.
 *
 * @param {Record<string, string | number | null | undefined>} parts empty ones are left out
 */
export function writeLink(parts) {
  const query = new URLSearchParams();
  for (const [key, value] of Object.entries(parts)) if (value != null && value !== "") query.set(key, String(value));
  // Commas and colons need no escape here, and people read addresses.
  const hash = query.toString().replaceAll("%2C", ",").replaceAll("%3A", ":").replaceAll("%7E", "~");
  const address = hash ? `#${hash}` : location.pathname;
  if (address !== location.hash) history.replaceState(null, "", address);
}

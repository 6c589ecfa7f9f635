/** Numbers about numbers: extents, percentiles, histograms, and how to write them. */

/**
 * @param {ArrayLike<number>} values @param {number} count
 * @param {boolean} [positive] only those above 0, as a logarithm needs
 * @returns {[number, number]}
 */
export function extentOf(values, count, positive = false) {
  let [low, high] = [Infinity, -Infinity];
  for (let k = 0; k < count; k++) {
    const x = values[k];
    if (positive && !(x > 0)) continue;
    if (x < low) low = x;
    if (x > high) high = x;
  }
  return low <= high ? [low, high] : positive ? [1e-12, 1] : [0, 1];
}

/**
 * @param {ArrayLike<number>} values @param {number} count @param {[number, number]} wanted percents
 * @param {boolean} [positive]
 * @returns {[number, number]}
 */
export function percentiles(values, count, wanted, positive = false) {
  const kept = new Float64Array(count);
  let n = 0;
  for (let k = 0; k < count; k++) if (Number.isFinite(values[k]) && (!positive || values[k] > 0)) kept[n++] = values[k];
  if (n === 0) return positive ? [1e-12, 1] : [0, 1];
  const sorted = kept.subarray(0, n).sort();
  return /** @type {[number, number]} */ (
    wanted.map((percent) => {
      const at = (Math.min(Math.max(percent, 0), 100) / 100) * (n - 1);
      const [a, b] = [Math.floor(at), Math.ceil(at)];
      return sorted[a] + (at - a) * (sorted[b] - sorted[a]);
    })
  );
}

/**
 * How many values lie in each of equal bins between two ends.
 *
 * @param {ArrayLike<number>} values @param {number} count @param {number} low @param {number} high @param {number} bins
 * @param {boolean} [logarithmic]
 */
export function histogram(values, count, low, high, bins, logarithmic = false) {
  const found = new Float64Array(bins);
  const [a, b] = logarithmic ? [Math.log(low), Math.log(high)] : [low, high];
  for (let k = 0; k < count; k++) {
    const x = logarithmic ? Math.log(values[k]) : values[k];
    const bin = Math.floor(((x - a) / (b - a)) * bins);
    if (bin >= 0 && bin < bins) found[bin]++;
    else if (x === b) found[bins - 1]++;
  }
  return found;
}

/** @param {number} x @returns {string} three significant digits, as people write them */
export function short(x) {
  if (x === 0) return "0";
  const size = Math.abs(x);
  if (size >= 1e5 || size < 1e-3) return x.toExponential(1).replace("e+", "e").replace("-", "−");
  return Number(x.toPrecision(3)).toLocaleString("en", { maximumSignificantDigits: 3 }).replace("-", "−");
}

/** @param {number} bytes */
export const megabytes = (bytes) => `${(bytes / 1e6).toFixed(1)} MB`;

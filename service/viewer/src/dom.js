/** Elements, made in one expression. */

/**
 * Element with attributes, listeners and children.
 *
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} name
 * @param {Record<string, any>} [attributes] `on…` functions listen; true sets a bare attribute; false, null leave it out
 * @param {...(Node | string | null)} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function h(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(key.slice(2), value);
    else if (value !== false && value != null) element.setAttribute(key, value === true ? "" : String(value));
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

/**
 * A labelled control on one line.
 *
 * @param {string} text
 * @param {HTMLElement} control
 * @param {string} [hint] shown on hover, and read out
 */
export function labelled(text, control, hint) {
  return h("label", { class: "row", title: hint }, h("span", {}, text), control);
}

/**
 * @param {Array<[string, string]>} options value and text
 * @param {string} value
 * @param {(value: string) => void} onChange
 * @param {string} [label]
 */
export function choice(options, value, onChange, label) {
  const select = h("select", { "aria-label": label, onchange: () => onChange(select.value) });
  offer(select, options, value);
  return select;
}

/**
 * Replace what a choice offers.
 *
 * @param {HTMLSelectElement} select
 * @param {Array<[string, string]>} options
 * @param {string} value
 */
export function offer(select, options, value) {
  select.replaceChildren(...options.map(([key, text]) => h("option", { value: key, selected: key === value }, text)));
}

/**
 * A button that stays pressed.
 *
 * @param {string} text
 * @param {{title?: string, pressed?: boolean, onToggle: (pressed: boolean) => void}} options
 */
export function toggle(text, { title, pressed = false, onToggle }) {
  const button = h("button", { type: "button", title, "aria-pressed": pressed, class: "toggle" }, text);
  button.addEventListener("click", () => {
    const now = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(now));
    onToggle(now);
  });
  return button;
}

/**
 * @param {string} name of the file
 * @param {Blob} content
 */
export function save(name, content) {
  const address = URL.createObjectURL(content);
  h("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

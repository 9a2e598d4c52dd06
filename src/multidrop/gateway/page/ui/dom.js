// Make HTML elements. A text always becomes a text node, so that no drive's name can become markup.

const SVG = "http://www.w3.org/2000/svg";

// Return an element. An attribute whose name starts with "on" becomes a listener. An attribute with the value
// null or false is left out. Children are elements, texts, or null, which is ignored.
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined) continue;
    if (name.startsWith("aria-")) element.setAttribute(name, String(value));
    else if (value === false) continue;
    else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  for (const child of children.flat()) if (child !== null && child !== undefined) element.append(child);
  return element;
}

// Return an element for a name from the plant file, isolated so that its writing direction cannot reorder the
// text around it.
export const named = (text, attributes = {}) => make("bdi", attributes, String(text));

// Return the head of a table. Each column's heading is a text, or a text and a CSS class. An empty text makes
// a cell without a heading.
export const tableHead = heads =>
  make(
    "thead",
    {},
    make(
      "tr",
      {},
      heads.map(head => {
        const [text, kind] = [head].flat();
        return text ? make("th", { scope: "col", class: kind }, text) : make("td");
      }),
    ),
  );

// Return one of the symbols that index.html defines.
export function glyph(name) {
  const svg = document.createElementNS(SVG, "svg"),
    use = document.createElementNS(SVG, "use");
  svg.setAttribute("class", "glyph");
  svg.setAttribute("aria-hidden", "true");
  use.setAttribute("href", `#glyph-${name}`);
  svg.append(use);
  return svg;
}

// Set an element's text, but only if it differs, because most texts stay the same.
export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function setClass(element, name, is) {
  if (element.classList.contains(name) !== is) element.classList.toggle(name, is);
}

export const fill = (element, ...children) =>
  element.replaceChildren(...children.flat().filter(c => c !== null));

export const find = (selector, at = document) => at.querySelector(selector);

// Return the value, in the present theme, of a colour that base.css defines; canvases need it.
export function colour(name) {
  const probe = make("i", { class: "hidden" });
  document.body.append(probe);
  probe.style.color = `var(--${name})`;
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}

// Make screen readers say a sentence.
export function say(text) {
  put(find("#said"), text);
}

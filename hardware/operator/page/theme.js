// Light or dark, as the system asks or somebody has chosen here, and the colours of both for what is drawn on a canvas.

const KEY = "stillbed.theme";
const root = document.documentElement, wanted = window.matchMedia("(prefers-color-scheme: dark)");
const changed = [];

/** What was kept in this browser under a key, null where nothing was or nothing may be. */
export function kept(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}
export function keep(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {} // a browser that keeps nothing: it is as it is for as long as the page is open
}
function set(theme) {
  root.dataset.theme = theme;
  colours = read();
  for (const each of changed) each();
}
function read() {
  const style = getComputedStyle(root);
  return Object.fromEntries(["ink", "soft", "faint", "card", "blue", "amber", "green", "rose", "true", "sky", "held", "path", "done"].map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}
/** The colours of the present theme, by name. */
export let colours = {};
export const dark = () => root.dataset.theme === "dark";
/** Calls when the theme has changed. */
export function onTheme(call) {
  changed.push(call);
}
export function toggleTheme() {
  const theme = dark() ? "light" : "dark";
  keep(KEY, theme);
  set(theme);
}
/** Makes a button toggle the theme and say which one it leads to. */
export function themeButton(button) {
  const tell = () => (button.textContent = dark() ? "Light" : "Dark");
  button.addEventListener("click", toggleTheme);
  onTheme(tell);
  tell();
}
wanted.addEventListener("change", () => kept(KEY) === null && set(wanted.matches ? "dark" : "light"));
set(kept(KEY) ?? (wanted.matches ? "dark" : "light"));
window.addEventListener("load", () => set(root.dataset.theme)); // the style sheet may come after this

"use strict";
// Menu of the faults of each link. A fault that makes the host lose the camera stands apart, and is confirmed.

const VERBS = {unplugged: "unplug", usb_unplugged: "unplug", ip_change: "change the address", lost_heartbeat: "take control away", link_down: "unplug the cable"};
const words = (kind) => VERBS[kind] || kind.replaceAll("_", " ");

function made(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element[name] = value;
    else if (value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

export function showFaults(box, links, send) {
  const able = Object.entries(links).filter(([, {faults}]) => Object.keys(faults).length);
  box.replaceChildren(...able.map(([link, {faults}]) => menu(link, faults, send)));
  if (!able.length && Object.keys(links).length) box.append("The links of this rig have no faults.");
}

function menu(link, faults, send) {
  const plain = Object.entries(faults).filter(([, one]) => !one.disconnects), apart = Object.entries(faults).filter(([, one]) => one.disconnects);
  const box = made("fieldset", {class: "faults"}, made("legend", {}, `Faults of ${link}`));
  if (plain.length) box.append(...choice(link, faults, plain.map(([kind]) => kind), send));
  if (apart.length) box.append(made("div", {class: "apart"}, ...apart.map(([kind, one]) => {
    const open = made("button", {type: "button", class: "danger", id: `fault-${link}-${kind}`, "aria-haspopup": "dialog"}, `${words(kind)} ...`);
    open.onclick = () => confirm(link, kind, one, send, open);
    return open;
  })));
  return box;
}

function choice(link, faults, kinds, send) {
  const id = `fault-${link}`, select = made("select", {id, "aria-describedby": `${id}-text`}, ...kinds.map((kind) => made("option", {value: kind}, words(kind))));
  const text = made("p", {id: `${id}-text`, class: "sentence"}), keys = made("div", {class: "keys"});
  const inject = made("button", {type: "button", id: `inject-${link}`}, "inject");
  inject.onclick = () => { const fault = read(link, select.value, keys); if (fault) send({do: "inject", fault}); };
  const renew = () => { text.textContent = faults[select.value].text.replaceAll("`", ""); keys.replaceChildren(...fields(faults[select.value])); };
  select.onchange = renew;
  renew();
  return [made("div", {class: "row"}, made("label", {for: id}, "fault"), select, inject), text, keys];
}

// Its keys, with their units in their names as in a rig.
function fields(fault) {
  return Object.entries(fault.keys).map(([name, {default: value, choices}]) => {
    const number = typeof value === "number";
    const input = choices ? made("select", {"data-key": name}, ...choices.map((one) => made("option", {}, one)))
      : made("input", {"data-key": name, type: number ? "number" : "text", step: "any", ...(number && value >= 0 ? {min: 0} : {})});
    input.value = input.defaultText = String(value);
    return made("label", {}, name, input);
  });
}

function read(link, kind, keys) {
  const fault = {kind, link};
  for (const input of keys.querySelectorAll("[data-key]")) {
    if (input.value === input.defaultText) continue;
    if (!input.reportValidity() || (input.type === "number" && input.value === "")) return null;
    fault[input.dataset.key] = input.type === "number" ? Number(input.value) : input.value;
  }
  return fault;
}

function confirm(link, kind, fault, send, opener) {
  const keys = made("div", {class: "keys"}, ...fields(fault));
  const dialog = made("dialog", {class: "confirm", "aria-labelledby": "confirm-head", "aria-describedby": "confirm-text"},
    made("h2", {id: "confirm-head"}, `${link}: ${words(kind)}?`),
    made("p", {id: "confirm-text"}, `${fault.text.replaceAll("`", "")} The host must open the camera again. This cannot be undone.`), keys);
  const cancel = made("button", {type: "button", autofocus: true, onclick: () => dialog.close()}, "cancel");
  const go = made("button", {type: "button", class: "danger", id: "confirm-go"}, words(kind));
  go.onclick = () => { const table = read(link, kind, keys); if (table) { send({do: "inject", fault: table}); dialog.close(); } };
  dialog.append(made("div", {class: "row"}, cancel, go));
  dialog.onclose = () => { dialog.remove(); opener.focus(); };
  document.body.append(dialog);
  dialog.showModal();
}

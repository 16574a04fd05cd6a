// The page of `sgc dashboard`: asks its server for documents about the fleet and shows the newest.
//
// Texts come from other machines. They are set as text and never parsed as markup.

const token = location.hash.slice(1);
const by = (id) => document.getElementById(id);
/** Time before a failed question is asked again, milliseconds. */
const AGAIN_MS = 2000;
/** Longest wait for an answer, milliseconds. The server waits for the nodes, and asks them for at most 10 s. */
const PATIENCE_MS = 20_000;
/** Longest wait for an operation, milliseconds. The server asks for the authority and gives it 40 s. */
const OPERATION_MS = 60_000;
const DAY_MS = 86_400_000;
/** Most rows and columns of the matrix of rights at first; each press of its button adds as many rows. */
const ROWS_MAX = 100;
const COLUMNS_MAX = 60;
/** Most events of audit logs at first; each press of its button adds as many. */
const EVENTS_MAX = 25;
/** Events by which somebody lost a right or did not get one, and those that changed the fleet. */
const REFUSALS = ["refused", "revoked", "cut", "link_refused", "token_refused", "token_revoked", "audit_lost"];
const CHANGES = ["operation", "crl", "reload", "token_made"];
/** Marks by state, so that color alone tells nothing. */
const MARKS = { here: "●", fault: "▲", linked: "◌", absent: "○", revoked: "✕" };

let view = null;
let arrived = 0;
let selected = null;
/** Whether the token lets the page revoke nodes. */
let mayOperate = false;
/** Of each node: the last report, and the rates since the one before, by direction and topic. */
const rates = new Map();

const ask = async (path) => {
  const headers = { authorization: `Bearer ${token}` };
  const answer = await fetch(path, { headers, signal: AbortSignal.timeout(PATIENCE_MS) });
  if (!answer.ok) throw new Error((await answer.text()) || answer.statusText);
  return answer.json();
};

/** Has the server revoke a node. */
const revoke = async (node) => {
  const answer = await fetch("/api/revoke", {
    method: "POST",
    headers: { authorization: `Bearer ${token}`, "content-type": "application/json" },
    body: JSON.stringify({ node }),
    signal: AbortSignal.timeout(OPERATION_MS),
  });
  if (!answer.ok) throw new Error((await answer.text()) || answer.statusText);
};

const setText = (element, text) => {
  delete element.dataset.text;
  if (element.textContent !== text) element.textContent = text;
};
const setAttribute = (element, name, value) => {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
};

/** Sets a text in which `backquotes` stand around what a user types or finds in a file. */
const setMarked = (element, text) => {
  if (element.dataset.text === text) return;
  element.dataset.text = text;
  element.replaceChildren(
    ...text.split("`").map((part, at) => {
      if (at % 2 === 0) return part;
      const code = document.createElement("code");
      code.textContent = part;
      return code;
    }),
  );
};

/**
 * Makes the children of `parent` those of `items`, by their keys; a key may come several times. Children that stay keep
 * the focus, unless their order changes.
 */
const sync = (parent, items, keyOf, create, update) => {
  const times = new Map();
  const wanted = new Map();
  for (const item of items) {
    const key = keyOf(item);
    times.set(key, (times.get(key) ?? 0) + 1);
    wanted.set(`${times.get(key)} ${key}`, item);
  }
  const known = new Map();
  for (const child of [...parent.children]) {
    if (wanted.has(child.dataset.key)) known.set(child.dataset.key, child);
    else child.remove();
  }
  let next = parent.firstElementChild;
  for (const [key, item] of wanted) {
    let child = known.get(key);
    if (!child) {
      child = create(item);
      child.dataset.key = key;
    }
    if (child === next) next = next.nextElementSibling;
    else parent.insertBefore(child, next);
    update(child, item);
  }
};

/** Rows of text. A cell is a text, or an element that is made once. */
const syncRows = (body, items, keyOf, cells) => {
  const part = body.closest(".part");
  if (part) part.hidden = items.length === 0;
  sync(
    body,
    items,
    keyOf,
    (item) => {
      const row = document.createElement("tr");
      for (const { make, number } of cells) {
        const cell = row.insertCell();
        if (number) cell.className = "number";
        if (make) cell.append(make(item));
      }
      return row;
    },
    (row, item) => {
      cells.forEach(({ make, text }, at) => {
        const cell = row.cells[at];
        if (text) setText(make ? cell.firstElementChild : cell, text(item));
      });
    },
  );
};

const duration = (seconds) => {
  const [d, h, m] = [Math.floor(seconds / 86_400), Math.floor(seconds / 3600) % 24, Math.floor(seconds / 60) % 60];
  if (d) return `${d} d ${h} h`;
  if (h) return `${h} h ${m} min`;
  return m ? `${m} min ${Math.floor(seconds % 60)} s` : `${Math.floor(seconds)} s`;
};
/** Returns a time as text of this length. A clock of another machine may be anything. */
const timeText = (ms, length) => {
  const date = new Date(ms);
  return Number.isNaN(date.getTime()) ? "?" : date.toISOString().replace("T", " ").slice(0, length);
};
const millis = (us) => (us < 10_000 ? `${(us / 1000).toFixed(2)} ms` : `${Math.round(us / 1000)} ms`);
const count = (n) => n.toLocaleString("en");

const nameOfId = (id) => view.known[id]?.[0] ?? id.slice(0, 8);
const nameOf = (link) => view.known[link.peer]?.[0] ?? link.name ?? nameOfId(link.peer);
const isRouter = (id) => view.known[id]?.[1] ?? false;
const idOf = (node) => node.member?.id;
const nodes = () => view.fleet.nodes;
/** Of the newest document: the names of nodes with a fault, and the ids of nodes to which another has a link. */
let faulty = new Set();
let linked = new Set();

const stateOf = (node) => {
  if (node.report) return faulty.has(node.name) ? "fault" : "here";
  if (node.member?.revoked_ms) return "revoked";
  return linked.has(idOf(node)) ? "linked" : "absent";
};

const stateText = (node) => {
  switch (stateOf(node)) {
    case "here": return "here";
    case "fault": return "needs attention";
    case "revoked": return "revoked";
    case "linked": return "no report, but linked";
    default: {
      const seen = node.member?.seen_ms;
      return seen ? `no report, seen ${duration((view.fleet.time_ms - seen) / 1000)} ago` : "no report";
    }
  }
};

const certificate = (node) => {
  const until = node.report?.certificate_until_ms ?? node.member?.expires_ms;
  if (!until) return "–";
  const left = until - view.fleet.time_ms;
  return left <= 0 ? "ended" : `${left > DAY_MS ? `${Math.floor(left / DAY_MS)} d` : duration(left / 1000)} left`;
};

const linksText = (report) => {
  const shown = report.links.slice(0, 2).map((link) => `${nameOf(link)} ${link.silent ? "silent" : millis(link.rtt_us)}`);
  const more = report.links.length + report.links_omitted - shown.length;
  if (more > 0) shown.push(`${more} more`);
  return shown.join(", ") || "none";
};

/** The part of a link's packets that was lost; reports of earlier versions have no counts. */
const lostOf = ({ sent_packets, lost_packets }) =>
  sent_packets && lost_packets ? `${((100 * lost_packets) / sent_packets).toFixed(1)} %` : "–";

/** Whether a link leads to the peer itself: only routers listen, so all but the direct links of another node lead to them. */
const isDirect = (report, link) => link.direct || (report.is_router && !isRouter(link.peer));

/** The path of a topic from its owner. */
const pathOf = ({ via, direct }) => (!via ? "–" : direct ? "direct" : `over ${nameOfId(via)}`);

/** The drops of a topic with their reasons, the most first. */
const dropsOf = (topic) => Object.entries(topic.drops ?? {}).sort(([, a], [, b]) => b - a);
const droppedOf = (topic) => dropsOf(topic).map(([reason, n]) => `${count(n)} ${reason}`).join(", ") || "–";
const meaningsOf = (topic) =>
  dropsOf(topic).map(([reason]) => `${reason}: ${view.meanings[reason] ?? "–"}`).join("\n");

const topicKey = (topic) => `${topic.direction} ${topic.topic} ${topic.owner} ${topic.type ?? ""}`;

/** Notes the reports of a new document, and the rates since those before. */
const measure = () => {
  const links = nodes().flatMap((node) => node.report?.links ?? []);
  faulty = new Set(view.faults.flatMap((fault) => fault.nodes));
  linked = new Set(links.filter((link) => !link.silent).map((link) => link.peer));
  const names = new Set(nodes().map((node) => node.name));
  for (const name of rates.keys()) if (!names.has(name)) rates.delete(name);
  for (const { name, report } of nodes()) {
    const before = rates.get(name);
    if (!report) {
      rates.delete(name);
      continue;
    }
    if (before?.report.clock_ms === report.clock_ms) continue;
    let topics = null;
    const seconds = before ? (report.clock_ms - before.report.clock_ms) / 1000 : 0;
    // After a restart the counters begin anew.
    if (seconds > 0 && report.uptime_s >= before.report.uptime_s) {
      topics = new Map();
      const earlier = new Map(before.report.topics.map((topic) => [topicKey(topic), topic.messages]));
      for (const topic of report.topics) {
        const more = topic.messages - earlier.get(topicKey(topic));
        // A topic that is new has no rate yet.
        if (more >= 0) topics.set(topicKey(topic), more / seconds);
      }
    }
    rates.set(name, { report, topics });
  }
};

const rateOf = (node, topic) => {
  const rate = rates.get(node.name)?.topics?.get(topicKey(topic));
  return rate === undefined ? "–" : rate.toFixed(1);
};
const rateOfNode = (node) => {
  const topics = rates.get(node.name)?.topics;
  return topics ? [...topics.values()].reduce((sum, rate) => sum + rate, 0).toFixed(1) : "–";
};

const button = (text, act) => {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.addEventListener("click", act);
  return made;
};

const select = (name) => {
  if (name !== selected) by("filter").value = "";
  selected = name;
  show();
  by("details-title").focus();
};

const showFaults = () => {
  by("no-faults").hidden = view.faults.length > 0;
  sync(
    by("faults"),
    view.faults,
    // Its words may change, such as the time since something was seen.
    (fault) => fault.nodes.join(),
    ({ nodes }) => {
      const [item, first] = [document.createElement("li"), document.createElement("div")];
      const [what, fix] = [document.createElement("span"), document.createElement("div")];
      const names = nodes.map((name) => button(name, () => select(name)));
      first.append(...names.flatMap((name, at) => (at ? [", ", name] : [name])), ": ", what);
      fix.className = "fix";
      item.append(first, fix);
      return item;
    },
    (item, { what, fix }) => {
      setText(item.querySelector("span"), what);
      setMarked(item.querySelector(".fix"), fix);
    },
  );
};

const showNodes = () => {
  const dash = (node, of) => (node.report ? of(node.report) : "–");
  syncRows(by("nodes"), nodes(), (node) => node.name, [
    { make: (node) => button(node.name, () => select(node.name)) },
    { make: () => document.createElement("span"), text: (node) => `${MARKS[stateOf(node)]} ${stateText(node)}` },
    { text: (node) => dash(node, (report) => duration(report.uptime_s)) },
    { text: (node) => dash(node, (report) => report.version) },
    { text: certificate },
    { text: (node) => dash(node, linksText) },
    { number: true, text: (node) => dash(node, (report) => count(report.topics.length + report.topics_omitted)) },
    { number: true, text: (node) => dash(node, () => rateOfNode(node)) },
  ]);
  nodes().forEach((node, at) => {
    const row = by("nodes").rows[at];
    setAttribute(row.cells[1].firstElementChild, "class", stateOf(node));
    setAttribute(row, "aria-current", String(node.name === selected));
  });
};

const svg = (tag) => document.createElementNS("http://www.w3.org/2000/svg", tag);

/** Returns a place for each node that has an id: routers inside, others around them. */
const places = () => {
  const all = nodes().filter(idOf);
  const rings = [all.filter((node) => isRouter(idOf(node))), all.filter((node) => !isRouter(idOf(node)))];
  const radii = [rings[0].length > 1 ? 90 : 0, 1];
  const found = new Map();
  rings.forEach((ring, at) => {
    ring.forEach((node, n) => {
      const angle = (2 * Math.PI * n) / ring.length - Math.PI / 2;
      const [x, y] = at ? [380 * Math.cos(angle), 215 * Math.sin(angle)] : [radii[0] * Math.cos(angle), radii[0] * Math.sin(angle)];
      found.set(idOf(node), { node, x, y });
    });
  });
  return found;
};

const showMap = () => {
  const at = places();
  const lines = new Map();
  for (const { report, member } of nodes()) {
    for (const link of report?.links ?? []) {
      if (!member || !at.has(link.peer)) continue;
      const key = [member.id, link.peer].sort().join("-");
      const known = lines.get(key);
      const silent = link.silent || (known?.silent ?? false);
      const lost = [known?.lost, lostOf(link)].filter((part) => part && part !== "–");
      const direct = link.direct || (known?.direct ?? false);
      lines.set(key, { key, from: member.id, to: link.peer, rtt_us: link.rtt_us, silent, direct, lost: lost[0] });
    }
  }
  const map = by("map");
  if (!map.firstElementChild) map.append(svg("g"), svg("g"));
  const [links, marks] = map.children;
  sync(
    links,
    [...lines.values()],
    (line) => line.key,
    () => {
      const line = svg("line");
      line.append(svg("title"));
      return line;
    },
    (element, { from, to, rtt_us, silent, direct, lost }) => {
      const [a, b] = [at.get(from), at.get(to)];
      for (const [name, value] of [["x1", a.x], ["y1", a.y], ["x2", b.x], ["y2", b.y]]) {
        setAttribute(element, name, value.toFixed(1));
      }
      setAttribute(element, "class", [direct && "direct", silent && "silent"].filter(Boolean).join(" "));
      const state = silent ? "silent" : `${millis(rtt_us)}${lost ? `, ${lost} lost` : ""}`;
      setText(element.firstElementChild, `${a.node.name} – ${b.node.name}: ${state}`);
    },
  );
  sync(
    marks,
    [...at.values()],
    ({ node }) => node.name,
    ({ node }) => {
      const group = svg("g");
      const [mark, name] = [svg("text"), svg("text")];
      name.setAttribute("class", "name");
      name.setAttribute("y", "31");
      group.append(mark, name);
      setAttribute(group, "class", "node");
      setAttribute(group, "role", "button");
      setAttribute(group, "tabindex", "0");
      group.addEventListener("click", () => select(node.name));
      group.addEventListener("keydown", (event) => {
        if (event.key === "Enter" || event.key === " ") {
          event.preventDefault();
          select(node.name);
        }
      });
      return group;
    },
    (group, { node, x, y }) => {
      const [mark, name] = group.children;
      setAttribute(group, "transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
      setAttribute(group, "aria-label", `${node.name}: ${stateText(node)}`);
      setAttribute(group, "aria-pressed", String(node.name === selected));
      setAttribute(mark, "class", `mark ${stateOf(node)}`);
      setText(mark, MARKS[stateOf(node)]);
      setText(name, node.name);
    },
  );
};

/** The number of the last question why. */
let asked = 0;

const explain = async (node, topic) => {
  const dialog = by("why");
  const question = ++asked;
  setText(by("why-title"), `${topic} at ${node}`);
  by("steps").replaceChildren("asking");
  dialog.showModal();
  let why;
  try {
    why = await ask(`/api/why?${new URLSearchParams({ node, interface: topic })}`);
  } catch (error) {
    why = { error: error.message, steps: [] };
  }
  // The dialog may be about another topic by now.
  if (question !== asked) return;
  const marks = { fine: "✓", wrong: "✗", unknown: "?" };
  const steps = why.error ? [{ verdict: "wrong", found: why.error, fix: null }] : why.steps;
  by("steps").replaceChildren(
    ...steps.map(({ verdict, found, fix }) => {
      const [item, what, remedy] = [document.createElement("li"), document.createElement("div"), document.createElement("div")];
      what.className = verdict;
      what.textContent = `${marks[verdict] ?? "?"} ${found}`;
      remedy.className = "fix";
      setMarked(remedy, fix ?? "");
      item.append(what, remedy);
      return item;
    }),
  );
};

/** Returns recipients with the members for whom they stand. */
const recipientsText = (words) => {
  const text = (word) => {
    const { members, doubt } = view.recipients.meanings[word] ?? { members: [] };
    const names = members.map((at) => view.recipients.members[at]);
    if (doubt) return `${word} (${doubtOf(word)})`;
    return word.startsWith("group:") ? `${word} (${names.join(", ")})` : word;
  };
  return words.map(text).join(", ") || "nobody";
};

/** The node that the dialog is about. */
let revoking = null;

const askToRevoke = (node) => {
  revoking = node.name;
  setText(by("revoke-title"), `Revoke ${node.name}?`);
  const warning = node.report?.members ? "It is the authority of the fleet: without it, nobody is renewed, enrolled or revoked from afar." : "";
  by("revoke-warning").hidden = !warning;
  setText(by("revoke-warning"), warning);
  by("revoke-name").value = "";
  by("revoke-name").disabled = false;
  by("revoke-do").disabled = true;
  setText(by("revoke-said"), "");
  by("revoke").showModal();
  by("revoke-name").focus();
};

by("revoke-name").addEventListener("input", () => {
  by("revoke-do").disabled = by("revoke-name").value !== revoking;
});
by("revoke-cancel").addEventListener("click", () => by("revoke").close());
by("revoke-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const name = revoking;
  if (by("revoke-do").disabled || by("revoke-name").value !== name) return;
  by("revoke-do").disabled = true;
  by("revoke-name").disabled = true;
  by("revoke-said").className = "";
  setText(by("revoke-said"), "The authority is asked.");
  let refused = null;
  try {
    await revoke(name);
  } catch (error) {
    refused = error.message;
  }
  // The dialog may be about another node by now.
  if (revoking !== name) return;
  if (refused === null) {
    by("revoke").close();
    by("details-title").focus();
    return;
  }
  by("revoke-name").disabled = false;
  by("revoke-do").disabled = false;
  by("revoke-said").className = "absent";
  setMarked(by("revoke-said"), refused);
  by("revoke-name").focus();
});
by("revoke-ask").addEventListener("click", () => {
  const node = view && nodes().find((node) => node.name === selected);
  if (node) askToRevoke(node);
});

const showDetails = () => {
  const node = nodes().find((node) => node.name === selected);
  by("details").hidden = !node;
  if (!node) return;
  const { report, member } = node;
  setText(by("details-title"), node.name);
  by("revoke-part").hidden = !mayOperate || !member || Boolean(member.revoked_ms);
  setText(by("revoke-ask"), `Revoke ${node.name}…`);
  const time = (ms) => (ms ? `${timeText(ms, 16)} UTC` : "–");
  const facts = [
    ["state", `${stateText(node)}${node.error ? `: ${node.error}` : ""}`],
    ["groups", member?.groups.join(", ") || "none"],
    ["may ask how it is doing", report?.rights ? recipientsText(report.rights.observers) : "–"],
    ...(report?.rights?.operators.length ? [["may change the fleet here", recipientsText(report.rights.operators)]] : []),
    ["certificate until", time(report?.certificate_until_ms ?? member?.expires_ms)],
    ["generation of the secret", String(report?.secret_generation ?? (member?.generation || "–"))],
    ["last seen by the authority", time(member?.seen_ms)],
    ["node id", member?.id ?? "–"],
  ];
  sync(
    by("facts"),
    facts.flatMap(([term, text]) => [{ tag: "dt", key: `dt ${term}`, text: term }, { tag: "dd", key: `dd ${term}`, text }]),
    ({ key }) => key,
    ({ tag }) => document.createElement(tag),
    (element, { text }) => setText(element, text),
  );
  syncRows(by("links"), report?.links ?? [], (link) => link.peer, [
    { text: nameOf },
    { text: (link) => (isDirect(report, link) ? "itself" : "a router") },
    { number: true, text: (link) => (link.silent ? "silent" : millis(link.rtt_us)) },
    { number: true, text: lostOf },
    { text: (link) => (link.dialled ? "this node" : "the other") },
  ]);
  const relayed = report?.not_direct ?? [];
  syncRows(by("not-direct"), relayed, (peer) => peer.peer, [
    { text: (peer) => view.known[peer.peer]?.[0] ?? peer.name },
    { text: (peer) => view.not_direct[peer.reason]?.why ?? view.not_direct.other.why },
    { make: () => document.createElement("span") },
  ]);
  relayed.forEach((peer, at) => {
    setMarked(by("not-direct").rows[at].cells[2].firstElementChild, view.not_direct[peer.reason]?.fix ?? "");
  });
  const more = report?.not_direct_omitted ?? 0;
  setText(by("not-direct-more"), more ? `and ${count(more)} more` : "");
  syncRows(by("routers"), report?.routers ?? [], (router) => router.router, [
    { text: (router) => router.router },
    { text: (router) => router.state },
    { text: (router) => router.last_failure ?? "" },
  ]);
  const wanted = by("filter").value.toLowerCase();
  const topics = (report?.topics ?? []).filter((topic) => topicKey(topic).toLowerCase().includes(wanted));
  const all = (report?.topics.length ?? 0) + (report?.topics_omitted ?? 0);
  setText(by("shown"), `${count(topics.length)} of ${count(all)}`);
  syncRows(by("topics"), topics, (topic) => `${node.name} ${topicKey(topic)}`, [
    { text: (topic) => topic.direction },
    { text: (topic) => topic.topic },
    { text: (topic) => topic.type ?? "?" },
    { text: (topic) => topic.owner },
    { text: pathOf },
    { number: true, text: (topic) => rateOf(node, topic) },
    { number: true, text: (topic) => count(topic.messages) },
    { number: true, text: (topic) => (Number.isInteger(topic.age_us) ? millis(topic.age_us) : "–") },
    { make: () => document.createElement("span"), text: droppedOf },
    { make: () => document.createElement("span"), text: (topic) => topic.state },
    { make: (topic) => button("why?", () => explain(node.name, topic.topic)) },
  ]);
  topics.forEach((topic, at) => {
    setAttribute(by("topics").rows[at].cells[9].firstElementChild, "class", topic.stuck ? "fault" : "");
    setAttribute(by("topics").rows[at].cells[8].firstElementChild, "title", meaningsOf(topic));
  });
  syncRows(by("drops"), Object.entries(report?.drops ?? {}), ([reason]) => reason, [
    { text: ([reason]) => reason },
    { number: true, text: ([, n]) => count(n) },
    { text: ([reason]) => view.meanings[reason] ?? "" },
  ]);
};

/** The reason why a recipient stands for nobody, though it should. */
const doubtOf = (word) => view.recipients.meanings[word]?.doubt ?? null;
const interfaceOf = (rule) => (rule.kind === "topic" ? rule.interface : `${rule.kind} ${rule.interface}`);

/** The rules of all nodes, each with its owner and the text by which it is found. */
const rules = () =>
  nodes().flatMap(({ name: owner, report }) =>
    (report?.rights?.rules ?? []).map((rule) => {
      const words = [...rule.to, ...rule.publish, ...rule.tokens.map((token) => `token ${token}`)];
      return { owner, rule, text: `${owner}:${interfaceOf(rule)} ${rule.except.join(" ")} ${words.join(" ")}`.toLowerCase() };
    }),
  );

/** The columns of the matrix: members, then partners, then tokens if there are any. */
const columns = (all) => {
  const { members, partners } = view.recipients;
  const found = members.map((name, at) => ({ name, at, kind: "member" }));
  found.push(...partners.map((name) => ({ name: `partner:${name}`, kind: "partner" })));
  if (all.some(({ rule }) => rule.tokens.length)) found.push({ name: "tokens", kind: "tokens" });
  return found;
};

/** Returns the rights of a column at a rule, as the classes of their marks. */
const rightsOf = ({ owner, rule }, column) => {
  if (column.kind === "tokens") return rule.tokens.length ? ["sub"] : [];
  if (column.kind === "member" && column.name === owner) return ["own"];
  const isMeant = (word) =>
    column.kind === "partner" ? word === column.name : view.recipients.meanings[word]?.members.includes(column.at);
  if (rule.kind !== "topic") return rule.to.some(isMeant) ? ["call"] : [];
  return [...(rule.to.some(isMeant) ? ["sub"] : []), ...(rule.publish.some(isMeant) ? ["pub"] : [])];
};

const VERBS = { own: "shares", sub: "may subscribe to", pub: "may publish on", call: "may call" };
let rowsMax = ROWS_MAX;
/** The columns that the matrix has. */
let head = "";

const mark = (right) => {
  const made = document.createElement("span");
  made.className = `right ${right}`;
  made.textContent = right;
  return made;
};

/** Sets recipients as they are written in a rule, those that stand for nobody with the reason. */
const setRecipients = (element, rule) => {
  const tokens = rule.tokens.map((token) => ({ text: `token ${token}` }));
  const more = rule.omitted ? [{ text: `${count(rule.omitted)} more` }] : [];
  const named = (words) => words.map((word) => ({ text: word, doubt: doubtOf(word) }));
  const lists = [["to", [...named(rule.to), ...tokens, ...more]], ["publish", rule.kind === "topic" ? named(rule.publish) : []]];
  const key = JSON.stringify(lists);
  if (element.dataset.shown === key) return;
  element.dataset.shown = key;
  element.replaceChildren(
    ...lists.filter(([, words]) => words.length).flatMap(([title, words], nth) => [
      `${nth ? ";" : ""} ${title} `,
      ...words.flatMap(({ text, doubt }, at) => {
        const part = document.createElement("span");
        part.className = doubt ? "doubt" : "";
        part.textContent = doubt ? `▲ ${text} (${doubt})` : text;
        return at ? [", ", part] : [part];
      }),
    ]),
  );
};

/** Says what the matrix does not show, and which recipients stand for nobody. */
const showNotes = () => {
  const doubtful = Object.keys(view.recipients.meanings).filter(doubtOf);
  const notes = doubtful.slice(0, 5).map((word) => ({ className: "fault", text: `${word} has rights, but ${doubtOf(word)}.` }));
  if (doubtful.length > 5) notes.push({ className: "fault", text: `${count(doubtful.length - 5)} more names in rules stand for nobody.` });
  const gaps = (is, text) => {
    const names = nodes().filter(is).map((node) => node.name);
    const more = names.length > 5 ? ` and ${count(names.length - 5)} more` : "";
    if (names.length) notes.push({ className: "gap", text: `${text}: ${names.slice(0, 5).join(", ")}${more}.` });
  };
  gaps((node) => !node.report && !node.member?.revoked_ms, "Not known, because there is no report, are the rules of");
  gaps((node) => node.report && !node.report.rights, "Not known, because of an earlier version of sgc, are the rules of");
  gaps((node) => node.report?.rights?.rules_omitted, "Not all rules have room in the report of");
  sync(
    by("rights-notes"),
    notes,
    (note) => note.text,
    (note) => Object.assign(document.createElement("li"), { className: note.className, textContent: note.text }),
    () => {},
  );
};

const showRights = () => {
  showNotes();
  const all = rules();
  const wanted = by("rights-filter").value.toLowerCase();
  const found = all.filter((row) => row.text.includes(wanted));
  const rows = found.slice(0, rowsMax);
  const wantedMember = by("members-filter").value.toLowerCase();
  const allColumns = columns(all);
  const foundColumns = allColumns.filter((column) => column.name.toLowerCase().includes(wantedMember));
  const shown = foundColumns.slice(0, COLUMNS_MAX);
  setText(
    by("rights-shown"),
    all.length
      ? `${count(rows.length)} of ${count(all.length)} interfaces, ${count(shown.length)} of ${count(allColumns.length)} columns`
      : "No node shares anything.",
  );
  const more = by("rights-more");
  more.hidden = rows.length === found.length;
  setText(more, `Show ${count(Math.min(ROWS_MAX, found.length - rows.length))} more interfaces`);
  by("matrix").hidden = rows.length === 0;
  const names = JSON.stringify(shown.map((column) => column.name));
  const body = by("rights");
  if (head !== names) {
    head = names;
    body.replaceChildren();
    by("rights-head").replaceChildren(
      ...["interface, with its rule", ...shown.map((column) => column.name)].map((text, at) => {
        const cell = document.createElement("th");
        cell.scope = "col";
        const inner = document.createElement("span");
        inner.textContent = text;
        inner.title = text;
        cell.className = at ? "column" : "";
        cell.append(inner);
        return cell;
      }),
    );
  }
  sync(
    body,
    rows,
    ({ owner, rule }) => `${owner} ${interfaceOf(rule)}`,
    ({ owner, rule }) => {
      const row = document.createElement("tr");
      const title = document.createElement("th");
      title.scope = "row";
      const [of, except, words] = ["of", "", "words"].map((className) =>
        Object.assign(document.createElement("span"), { className }),
      );
      of.textContent = `${owner}:`;
      title.append(of, interfaceOf(rule), except, words);
      row.append(title);
      for (let at = 0; at < shown.length; at++) row.insertCell();
      return row;
    },
    (element, row) => {
      const except = row.rule.except.length ? ` except ${row.rule.except.join(", ")}` : "";
      const [, exceptPart, words] = element.cells[0].children;
      setText(exceptPart, except);
      setRecipients(words, row.rule);
      shown.forEach((column, at) => {
        const cell = element.cells[at + 1];
        const rights = rightsOf(row, column);
        if (cell.dataset.shown === rights.join()) return;
        cell.dataset.shown = rights.join();
        cell.replaceChildren(...rights.map(mark));
        cell.title = rights.map((right) => `${column.name} ${VERBS[right]} ${interfaceOf(row.rule)} of ${row.owner}`).join("; ");
      });
    },
  );
};

let eventsMax = EVENTS_MAX;
const isRefusal = (one) => REFUSALS.includes(one.event);
const eventText = (one) => `${isRefusal(one) ? "▲ " : ""}${one.event.replaceAll("_", " ")}`;
const eventMark = (one) => {
  const className = isRefusal(one) ? "fault" : CHANGES.includes(one.event) ? "linked" : "";
  return Object.assign(document.createElement("span"), { className });
};

const showAudit = () => {
  const { events, gaps } = view.audit;
  sync(
    by("audit-gaps"),
    gaps,
    (gap) => gap,
    (gap) => Object.assign(document.createElement("li"), { textContent: `Not known: ${gap}.` }),
    () => {},
  );
  const wanted = by("audit-filter").value.toLowerCase();
  const text = (one) => `${one.node} ${one.event} ${one.peer ?? ""} ${one.topic ?? ""} ${one.detail}`.toLowerCase();
  const found = events.filter((one) => text(one).includes(wanted));
  const shown = found.slice(0, eventsMax);
  setText(by("audit-shown"), events.length ? `the newest ${count(shown.length)} of ${count(found.length)}` : "No events yet.");
  const more = by("audit-more");
  more.hidden = shown.length === found.length;
  setText(more, `Show ${count(Math.min(EVENTS_MAX, found.length - shown.length))} more events`);
  syncRows(by("audit"), shown, (one) => `${one.node} ${one.time_ms} ${one.event} ${one.peer} ${one.topic} ${one.detail}`, [
    { text: (one) => timeText(one.time_ms, 19) },
    { text: (one) => one.node },
    { make: eventMark, text: eventText },
    { text: (one) => one.peer ?? "" },
    { text: (one) => one.topic ?? "" },
    { text: (one) => one.detail },
  ]);
};

const show = () => {
  if (!view) return;
  const omitted = view.fleet.members_omitted;
  setText(by("summary"), omitted ? `${view.summary}; ${count(omitted)} more are not shown` : view.summary);
  document.title = view.faults.length ? `(${view.faults.length}) SGC fleet` : "SGC fleet";
  showFaults();
  showMap();
  showNodes();
  showDetails();
  showRights();
  showAudit();
};

const fail = (text) => {
  by("error").hidden = !text;
  document.body.classList.toggle("stale", Boolean(text));
  setText(by("error"), text ?? "");
};

by("filter").addEventListener("input", () => view && showDetails());
for (const id of ["rights-filter", "members-filter"]) {
  by(id).addEventListener("input", () => {
    rowsMax = ROWS_MAX;
    if (view) showRights();
  });
}
by("audit-filter").addEventListener("input", () => {
  eventsMax = EVENTS_MAX;
  if (view) showAudit();
});
by("audit-more").addEventListener("click", () => {
  eventsMax += EVENTS_MAX;
  showAudit();
});
by("rights-more").addEventListener("click", () => {
  rowsMax += ROWS_MAX;
  showRights();
});
let age_ms = null;
setInterval(() => {
  if (age_ms !== null) setText(by("age"), `as of ${duration((age_ms + Date.now() - arrived) / 1000)} ago`);
}, 1000);

/** Waits until the page can be seen, so that nodes are not asked for nobody. */
const seen = () =>
  new Promise((done) => {
    const look = () => {
      if (document.hidden) return;
      document.removeEventListener("visibilitychange", look);
      done();
    };
    document.addEventListener("visibilitychange", look);
    look();
  });

for (let seq = 0; ; ) {
  await seen();
  try {
    const answer = await ask(`/api/fleet?after=${seq}`);
    [age_ms, arrived, mayOperate] = [answer.age_ms, Date.now(), answer.may_operate];
    if (answer.view && answer.view.seq > seq) {
      [view, seq] = [answer.view, answer.view.seq];
      measure();
      show();
    }
    fail(view?.error);
  } catch (error) {
    fail(`The page cannot be kept up to date: ${error.message}`);
    await new Promise((done) => setTimeout(done, AGAIN_MS));
  }
}

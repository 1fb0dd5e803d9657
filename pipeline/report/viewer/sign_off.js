/**
 * The reader's decision as a file. Stands before the viewer in the script of the page, so that it works without WebGL;
 * the facts that tie it to the result are JSON in an attribute of its section.
 */

/** What is still missing, as sentences for the reader. */
function missingWords({ decision, initials, remark, date }) {
  const sentences = [];
  if (!decision) sentences.push("Choose accept, accept with remark, or reject.");
  if (decision && decision !== "accept" && !remark) sentences.push("Write a remark: what is wrong, or what to mind.");
  if (!/^[\p{L}\p{N}][\p{L}\p{N}. -]{0,9}$/u.test(initials)) sentences.push("Give your initials, at most ten letters.");
  if (!/^\d{4}-\d{2}-\d{2}$/.test(date)) sentences.push("Give the date.");
  return sentences;
}

/** Today where the reader is, as a field of a date takes it. */
function today() {
  const now = new Date();
  return [now.getFullYear(), now.getMonth() + 1, now.getDate()].map((n) => String(n).padStart(2, "0")).join("-");
}

/** Hand a text to the reader as a file of their own; nothing is sent anywhere. */
function download(name, text) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

function listenToSignOff(root) {
  const one = (selector) => root.querySelector(selector);
  const facts = JSON.parse(root.dataset.facts);
  const typed = () => ({
    decision: one("input[name=decision]:checked")?.value ?? "",
    initials: one("input[name=initials]").value.trim(),
    remark: one("textarea").value.trim(),
    date: one("input[name=date]").value,
  });
  one("input[name=date]").value = today();
  one("button").addEventListener("click", () => {
    const review = typed();
    const missing = missingWords(review);
    const name = `${facts.case_id}_review.json`;
    if (!missing.length) download(name, `${JSON.stringify({ ...facts, ...review }, null, 1)}\n`);
    one("[role=status]").textContent = missing.join(" ") || `The browser saves it as ${name}, in its folder for downloads.`;
    one("[role=status]").classList.toggle("refused", missing.length > 0);
  });
  root.classList.add("live");
}

listenToSignOff(document.getElementById("sign-off"));

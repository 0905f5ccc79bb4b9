// The one form of dates and times on all pages: 30 Nov 2026, 14:05:09, in the browser's time zone.

const form = (options) => new Intl.DateTimeFormat("en-GB", options);
const FORMS = {
  moment: form({ dateStyle: "medium", timeStyle: "medium" }),
  day: form({ dateStyle: "medium" }),
  time: form({ timeStyle: "medium" }),
  minute: form({ timeStyle: "short" }),
};

// `at` is ISO text or seconds since 1970; what is not known, or no time, is "–".
export function date(at, name = "moment") {
  const moment = new Date(typeof at === "number" ? 1000 * at : at ?? "");
  return Number.isNaN(moment.getTime()) ? "–" : FORMS[name].format(moment);
}

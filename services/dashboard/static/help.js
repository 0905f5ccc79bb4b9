// The help page; its text comes from the server.

import { startTheme } from "./theme.js";

startTheme(document.getElementById("theme"), () => {});

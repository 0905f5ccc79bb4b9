// Swagger UI of this service's own document; it asks no other host.
"use strict";

SwaggerUIBundle({
  url: "/openapi.json",
  dom_id: "#api",
  deepLinking: true,
  defaultModelsExpandDepth: 0,
  displayOperationId: true,
  validatorUrl: null,
  onComplete() {
    document.title = `${document.querySelector("#api h1, #api h2").firstChild.textContent}: API`;
  },
});

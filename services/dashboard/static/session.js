// Requests of the page; without a session it is loaded anew, which shows the sign-in.

export async function ask(path, options) {
  const answer = await fetch(path, options);
  if (answer.status === 401) location.reload();
  return answer;
}

// The three.js that the page has loaded already, for what is bundled apart.
module.exports = globalThis.THREE;

// uPlot, for the curves of `flx watch`; `make vendor` bundles it into flx/viewer/uplot.min.js.
module.exports = require("uplot");

"use strict";
// plotly.js measures the letters of 3D labels by reading a 2D canvas back; Chromium warns unless the canvas was made for that.
{
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return getContext.call(this, kind, kind === "2d" ? { willReadFrequently: true, ...options } : options);
  };
}

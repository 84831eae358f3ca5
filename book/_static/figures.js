// Draws the plotly figures of a page when they come into view, and follows the page's light or dark theme.
(() => {
  // Pausing an animation makes plotly reject its promise without a reason; that is no error.
  addEventListener("unhandledrejection", (event) => { if (event.reason === undefined) event.preventDefault(); });
  const colours = () => {
    const dark = document.documentElement.dataset.theme === "dark";
    const text = dark ? "#ced6dd" : "#222832";
    return { "font.color": text, "legend.font.color": text, "sliders[0].currentvalue.font.color": text };
  };
  const draw = async (div) => {
    const figure = JSON.parse(div.querySelector("script").textContent);
    div.replaceChildren();
    figure.config = { responsive: true, displaylogo: false, scrollZoom: false, ...(figure.config || {}) };
    await Plotly.newPlot(div, figure);
    paint(div);
  };
  const paint = (div) => {
    const wanted = colours();
    if (!(div.layout.sliders || []).length) delete wanted["sliders[0].currentvalue.font.color"];
    Plotly.relayout(div, wanted);
  };
  const figures = [...document.querySelectorAll(".plotly-figure")];
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) { seen.unobserve(entry.target); draw(entry.target); }
  }, { rootMargin: "200px" });
  figures.forEach((figure) => seen.observe(figure));
  new MutationObserver(() => figures.filter((figure) => figure._fullLayout).forEach(paint))
    .observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme"] });
})();

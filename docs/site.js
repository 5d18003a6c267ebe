// What MkDocs' theme leaves out: the bar on top as a landmark, and wide tables and code that the keyboard can scroll
document.querySelector(".navbar").setAttribute("role", "banner");
addEventListener("load", () => {
  for (const wide of document.querySelectorAll(".col-md-9 pre, .col-md-9 table"))
    if (wide.scrollWidth > wide.clientWidth) wide.tabIndex = 0;
});

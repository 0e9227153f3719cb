"use strict";
// A table that is wider than the window says so, and has a shade at the edge behind which it goes on.
for (const box of document.querySelectorAll(".scroll")) {
  const look = () => {
    box.previousElementSibling.hidden = box.scrollWidth <= box.clientWidth;
    box.classList.toggle("cut", box.scrollLeft + box.clientWidth < box.scrollWidth - 1);
  };
  const observer = new ResizeObserver(look);
  observer.observe(box);
  observer.observe(box.firstElementChild);
  box.addEventListener("scroll", look);
  look();
}

// A scene of the gallery runs while it is in sight.
const sight = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    const [world, film] = [target.dataset.world, target.querySelector("video")];
    target.querySelector("iframe")?.remove();
    film?.pause();
    if (!isIntersecting) continue;
    if (world) target.firstElementChild.append(Object.assign(document.createElement("iframe"), { src: world, title: target.innerText }));
    else if (!matchMedia("(prefers-reduced-motion: reduce)").matches) film.play().catch(() => {});
  }
}, { rootMargin: "15%" });
for (const scene of document.querySelectorAll(".scene")) sight.observe(scene);

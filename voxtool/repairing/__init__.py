"""Any mesh made closed, consistently wound and manifold (a package `voxtool.repair` would hide the
function)."""

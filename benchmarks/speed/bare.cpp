// The bare step in plain loops: force of every element, then the central difference of every node.
// Compiled by benchmarks/peers.py with g++ -O3 -march=native, as the yardstick of `make bench`.

template <class Real>
static void steps(long elements, long nodes, const int* triangles, const Real* metric, const Real* weight,
                  const Real* compliance, Real* x, Real* v, Real* f, Real c, Real alpha, Real pressure, Real dt,
                  long count) {
  const Real p = pressure / 6;
  for (long step = 0; step < count; ++step) {
    for (long i = 0; i < 3 * nodes; ++i) f[i] = 0;
    for (long e = 0; e < elements; ++e) {
      const Real *a = x + 3 * triangles[3 * e], *b = x + 3 * triangles[3 * e + 1], *d = x + 3 * triangles[3 * e + 2];
      const Real u[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, w[3] = {d[0] - a[0], d[1] - a[1], d[2] - a[2]};
      const Real g11 = u[0] * u[0] + u[1] * u[1] + u[2] * u[2], g12 = u[0] * w[0] + u[1] * w[1] + u[2] * w[2],
                 g22 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
      const Real r11 = metric[3 * e], r12 = metric[3 * e + 1], r22 = metric[3 * e + 2];
      const Real trace = r11 * g11 + 2 * r12 * g12 + r22 * g22, area = r11 * r22 - r12 * r12;
      const Real thinning = 1 / ((g11 * g22 - g12 * g12) * area), first = 2 * c * weight[e], second = alpha * first;
      const Real A = first + second * thinning,
                 B = area * (second - thinning * thinning * (first + second * trace));
      const Real s11 = A * r11 + B * g22, s12 = A * r12 - B * g12, s22 = A * r22 + B * g11;
      const Real n[3] = {p * (u[1] * w[2] - u[2] * w[1]), p * (u[2] * w[0] - u[0] * w[2]),
                         p * (u[0] * w[1] - u[1] * w[0])};
      Real *fa = f + 3 * triangles[3 * e], *fb = f + 3 * triangles[3 * e + 1], *fd = f + 3 * triangles[3 * e + 2];
      for (int k = 0; k < 3; ++k) {
        const Real pull2 = s11 * u[k] + s12 * w[k], pull3 = s12 * u[k] + s22 * w[k];
        fa[k] += n[k] + pull2 + pull3;
        fb[k] += n[k] - pull2;
        fd[k] += n[k] - pull3;
      }
    }
    for (long i = 0; i < 3 * nodes; ++i) {
      v[i] += dt * f[i] * compliance[i];
      x[i] += dt * v[i];
    }
  }
}

extern "C" void steps_float64(long elements, long nodes, const int* triangles, const double* metric,
                              const double* weight, const double* compliance, double* x, double* v, double* f,
                              double c, double alpha, double pressure, double dt, long count) {
  steps(elements, nodes, triangles, metric, weight, compliance, x, v, f, c, alpha, pressure, dt, count);
}

extern "C" void steps_float32(long elements, long nodes, const int* triangles, const float* metric,
                              const float* weight, const float* compliance, float* x, float* v, float* f, float c,
                              float alpha, float pressure, float dt, long count) {
  steps(elements, nodes, triangles, metric, weight, compliance, x, v, f, c, alpha, pressure, dt, count);
}

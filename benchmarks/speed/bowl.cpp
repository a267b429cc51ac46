// The whole run of a sheet that pressure blows against a mold, in plain C++: the method of the package without its
// derivatives. Membrane forces, central difference with damping, contact with triangles through a grid, nodes that
// stick, elements that are dropped once their nodes do. The steps' lengths are given. Compiled by benchmarks/speed/bowl.py.

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

typedef double Four __attribute__((vector_size(32)));
typedef long Order __attribute__((vector_size(32)));

Four shuffle(Four a, Four b, Order order) { return __builtin_shuffle(a, b, order); }

// Four rows (x, y, z, 0) become the columns x, y, z, 0 of four; and back.
void transpose(Four& a, Four& b, Four& c, Four& d) {
  const Four low = shuffle(a, b, Order{0, 4, 2, 6}), high = shuffle(a, b, Order{1, 5, 3, 7}),
             low2 = shuffle(c, d, Order{0, 4, 2, 6}), high2 = shuffle(c, d, Order{1, 5, 3, 7});
  a = shuffle(low, low2, Order{0, 1, 4, 5}), b = shuffle(high, high2, Order{0, 1, 4, 5});
  c = shuffle(low, low2, Order{2, 3, 6, 7}), d = shuffle(high, high2, Order{2, 3, 6, 7});
}

template <class T>
struct Vector {
  T x, y, z;
  Vector operator-(const Vector& o) const { return {x - o.x, y - o.y, z - o.z}; }
  Vector operator+(const Vector& o) const { return {x + o.x, y + o.y, z + o.z}; }
  Vector operator*(T s) const { return {s * x, s * y, s * z}; }
  T dot(const Vector& o) const { return x * o.x + y * o.y + z * o.z; }
  Vector cross(const Vector& o) const { return {y * o.z - z * o.y, z * o.x - x * o.z, x * o.y - y * o.x}; }
};
typedef Vector<double> Point;

Point point(const Four& a) { return {a[0], a[1], a[2]}; }

struct Triangle {  // of the mold
  Point corner, normal, dual1, dual2, side[3];  // the sides' normals, in its plane and outwards
  double place[3];                              // of the sides along these

  // No more than the square of a point's distance.
  double square(const Point& p) const {
    const double height = (p - corner).dot(normal);
    double outside = 0;
    for (int k = 0; k < 3; ++k) outside = std::max(outside, p.dot(side[k]) - place[k]);
    return height * height + outside * outside;
  }
};

struct Elements {  // four side by side; those beyond the last have the nodes of a triangle that is no part of the sheet
  int node[3][4];
  Four r11, r12, r22, weight;
};

struct Mold {
  std::vector<Triangle> triangles;
  std::vector<int> start, listed;  // triangles nearer to a cell than `reach`
  Point low;
  double reach, touch;
  int count[3];

  Mold(const double* vertices, long triangle_count, const int* corners, const double* box, double width,
       double touch)
      : low{box[0], box[1], box[2]}, reach(width), touch(touch) {
    for (int k = 0; k < 3; ++k) count[k] = std::max(1, int(std::ceil((box[3 + k] - box[k]) / width)));
    std::vector<std::vector<int>> cells(count[0] * count[1] * count[2]);
    for (int t = 0; t < triangle_count; ++t) {
      Point p[3], least{1e300, 1e300, 1e300}, most{-1e300, -1e300, -1e300};
      for (int k = 0; k < 3; ++k) {
        const double* v = vertices + 3 * corners[3 * t + k];
        p[k] = {v[0], v[1], v[2]};
        least = {std::min(least.x, v[0]), std::min(least.y, v[1]), std::min(least.z, v[2])};
        most = {std::max(most.x, v[0]), std::max(most.y, v[1]), std::max(most.z, v[2])};
      }
      const Point u = p[1] - p[0], w = p[2] - p[0], n = u.cross(w);
      const double square = n.dot(n);
      Triangle own{p[0], n * (1 / std::sqrt(square)), w.cross(n) * (1 / square), n.cross(u) * (1 / square)};
      for (int k = 0; k < 3; ++k) {
        const Point out = (p[(k + 1) % 3] - p[k]).cross(n);
        own.side[k] = out * (1 / std::sqrt(out.dot(out))), own.place[k] = own.side[k].dot(p[k]);
      }
      triangles.push_back(own);
      const Point around{reach, reach, reach}, from = least - around, to = most + around;
      int a[3], b[3];
      cell(from, a), cell(to, b);
      for (int i = a[0]; i <= b[0]; ++i)
        for (int j = a[1]; j <= b[1]; ++j)
          for (int k = a[2]; k <= b[2]; ++k) {
            const Point middle = low + Point{i + 0.5, j + 0.5, k + 0.5} * reach;
            const double far = reach * (1 + std::sqrt(0.75));
            if (own.square(middle) <= far * far) cells[(i * count[1] + j) * count[2] + k].push_back(t);
          }
    }
    start.push_back(0);
    for (const auto& own : cells) {
      listed.insert(listed.end(), own.begin(), own.end());
      start.push_back(listed.size());
    }
  }

  void cell(const Point& p, int* index) const {
    const double place[3] = {p.x - low.x, p.y - low.y, p.z - low.z};
    for (int k = 0; k < 3; ++k) index[k] = std::clamp(int(std::floor(place[k] / reach)), 0, count[k] - 1);
  }

  // Square of how far a node at p may go before it can touch a triangle.
  double clear_square(const Point& p) const {
    int i[3];
    cell(p, i);
    const int own = (i[0] * count[1] + i[1]) * count[2] + i[2];
    double least = reach * reach;
    for (int k = start[own]; k < start[own + 1]; ++k) least = std::min(least, triangles[listed[k]].square(p));
    const double way = std::max(0.0, std::sqrt(least) - 2 * touch);
    return way * way;
  }

  // The first triangle that the path meets moves its end there.
  bool stops(const Point& before, Point& after) const {
    int i[3];
    cell(before, i);
    const int own = (i[0] * count[1] + i[1]) * count[2] + i[2];
    const Point way = after - before;
    double best = 2;
    for (int k = start[own]; k < start[own + 1]; ++k) {
      const Triangle& t = triangles[listed[k]];
      const Point away = before - t.corner;
      const double height = away.dot(t.normal), fall = -way.dot(t.normal);
      const bool crosses = fall != 0 && height * (height - fall) <= 0;
      if (!crosses && std::abs(height) > touch) continue;
      const double beta = fall == 0 ? 0 : std::clamp(height / fall, 0.0, 1.0);
      const Point met = away + way * beta;
      const double gamma = met.dot(t.dual1), delta = met.dot(t.dual2), tolerance = 1e3 * 2.2e-16;
      if (gamma >= -tolerance && delta >= -tolerance && gamma + delta <= 1 + tolerance) best = std::min(best, beta);
    }
    if (best <= 1) after = before + way * best;
    return best <= 1;
  }
};

// The forces of four elements each time: their nodes are read and written as rows of four numbers.
void add_forces(const std::vector<Elements>& elements, const Four* x, Four* f, double c, double alpha,
                double pressure) {
  const double p = pressure / 6;
  for (const Elements& e : elements) {
    Four corner[3][4];
    for (int k = 0; k < 3; ++k) {
      for (int i = 0; i < 4; ++i) corner[k][i] = x[e.node[k][i]];
      transpose(corner[k][0], corner[k][1], corner[k][2], corner[k][3]);
    }
    const Vector<Four> a{corner[0][0], corner[0][1], corner[0][2]}, b{corner[1][0], corner[1][1], corner[1][2]},
        d{corner[2][0], corner[2][1], corner[2][2]}, u = b - a, w = d - a;
    const Four g11 = u.dot(u), g12 = u.dot(w), g22 = w.dot(w);
    const Four trace = e.r11 * g11 + 2 * e.r12 * g12 + e.r22 * g22, area = e.r11 * e.r22 - e.r12 * e.r12;
    const Four thinning = 1 / ((g11 * g22 - g12 * g12) * area), first = 2 * c * e.weight, second = alpha * first;
    const Four A = first + second * thinning,
               B = area * (second - thinning * thinning * (first + second * trace));
    const Four s11 = A * e.r11 + B * g22, s12 = A * e.r12 - B * g12, s22 = A * e.r22 + B * g11;
    const Vector<Four> n = u.cross(w) * (Four{} + p), pull2 = u * s11 + w * s12, pull3 = u * s12 + w * s22;
    const Vector<Four> force[3] = {n + pull2 + pull3, n - pull2, n - pull3};
    for (int k = 0; k < 3; ++k) {
      Four row[4] = {force[k].x, force[k].y, force[k].z, Four{}};
      transpose(row[0], row[1], row[2], row[3]);
      for (int i = 0; i < 4; ++i) f[e.node[k][i]] += row[i];
    }
  }
}

}  // namespace

extern "C" void* make_mold(const double* vertices, long triangle_count, const int* corners, const double* box,
                           double width, double touch) {
  return new Mold(vertices, triangle_count, corners, box, width, touch);
}

// The windows' steps from rest; positions are overwritten. Gives the number of element steps.
extern "C" long run_windows(long element_count, long node_count, const int* triangles, const double* metric,
                            const double* weight, const double* compliance, const unsigned char* clamped,
                            double* positions, double c, double alpha, double damping, long knots,
                            const double* knot_times, const double* knot_pressures, const void* with_mold,
                            long window_count, const double* lengths, const int* counts) {
  const Mold& mold = *static_cast<const Mold*>(with_mold);
  const int none = node_count;  // the first of three nodes that stand for those of no element
  std::vector<Four> x(node_count + 3), v(node_count + 3), f(node_count + 3), mobile(node_count + 3), from(node_count);
  std::vector<unsigned char> stuck(clamped, clamped + node_count);
  std::vector<double> clear(node_count);  // square of how far from there a node goes before it can touch the mold
  std::vector<int> moving(element_count), nodes;
  for (long i = 0; i < node_count; ++i)
    for (int k = 0; k < 3; ++k) x[i][k] = positions[3 * i + k], mobile[i][k] = compliance[3 * i + k];
  x[none + 1][0] = x[none + 2][1] = 1;
  for (long e = 0; e < element_count; ++e) moving[e] = e;
  std::vector<Elements> elements;
  double time = 0, before = 0;
  long done = 0, knot = 0;
  bool changed = true;
  for (long window = 0; window < window_count; ++window) {
    const double length = lengths[window];
    if (changed) {
      std::erase_if(moving, [&](int e) {
        return stuck[triangles[3 * e]] && stuck[triangles[3 * e + 1]] && stuck[triangles[3 * e + 2]];
      });
      if (moving.empty()) break;
      elements.assign((moving.size() + 3) / 4, Elements{{{none, none, none, none},
                                                          {none + 1, none + 1, none + 1, none + 1},
                                                          {none + 2, none + 2, none + 2, none + 2}},
                                                         Four{} + 1, Four{}, Four{} + 1, Four{}});
      for (size_t k = 0; k < moving.size(); ++k) {
        Elements& own = elements[k / 4];
        const int i = k % 4, e = moving[k];
        for (int j = 0; j < 3; ++j) own.node[j][i] = triangles[3 * e + j];
        own.r11[i] = metric[3 * e], own.r12[i] = metric[3 * e + 1], own.r22[i] = metric[3 * e + 2];
        own.weight[i] = weight[e];
      }
      nodes.clear();
      for (long i = 0; i < node_count; ++i)
        if (!stuck[i]) nodes.push_back(i);
      changed = false;
    }
    for (int step = 0; step < counts[window]; ++step) {
      const double now = time + step * length, update = step ? length : 0.5 * (before + length);
      while (knot + 2 < knots && now >= knot_times[knot + 1]) ++knot;
      const double share = (now - knot_times[knot]) / (knot_times[knot + 1] - knot_times[knot]);
      const double pressure =
          knot_pressures[knot] + std::min(share, 1.0) * (knot_pressures[knot + 1] - knot_pressures[knot]);
      add_forces(elements, x.data(), f.data(), c, alpha, pressure);
      const double half = 0.5 * damping * update, keep = (1 - half) / (1 + half), gain = update / (1 + half);
      for (int i : nodes) {
        v[i] = keep * v[i] + gain * f[i] * mobile[i];
        f[i] = Four{};  // what others gather is of no use
        const Four old = x[i], gap = (x[i] += length * v[i]) - from[i], square = gap * gap;
        if (square[0] + square[1] + square[2] < clear[i] || stuck[i]) continue;
        Point end = point(x[i]);
        if (mold.stops(point(old), end)) {
          x[i] = Four{end.x, end.y, end.z, 0}, v[i] = mobile[i] = Four{};
          stuck[i] = changed = true;
        } else {
          from[i] = x[i], clear[i] = mold.clear_square(end);
        }
      }
      done += moving.size(), before = length;
    }
    time += counts[window] * length;
  }
  for (long i = 0; i < node_count; ++i)
    for (int k = 0; k < 3; ++k) positions[3 * i + k] = x[i][k];
  return done;
}

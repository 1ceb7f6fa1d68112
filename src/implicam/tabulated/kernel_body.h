/* The work of kernel.c, for one kind of processor; NAME gives functions and types the name of it.

   Eight floats are one register (WIDE, AVX2), two of four floats (SSE, NEON: what nobody asks for of the second is
   left out by the compiler), or an array that any compiler takes. */

#undef LOAD
#undef MADD
#undef LANE
#undef ZERO8
#define Eight NAME(Eight)
#if defined(WIDE)
typedef float Eight __attribute__((vector_size(32)));
typedef float NAME(Anywhere) __attribute__((vector_size(32), aligned(4), may_alias));
#define LOAD(at) (*(const NAME(Anywhere) *)(at))
#define MADD(sum, factor, eight) ((sum) += (factor) * (eight))
#define LANE(eight, k) ((double)(eight)[k])
#define ZERO8 {0}
#elif defined(__GNUC__)
typedef float NAME(Four) __attribute__((vector_size(16)));
typedef float NAME(Anywhere) __attribute__((vector_size(16), aligned(4), may_alias));
typedef struct { NAME(Four) low, high; } Eight;
INLINE Eight NAME(load)(const float *at) {
  const Eight out = {*(const NAME(Anywhere) *)at, *(const NAME(Anywhere) *)(at + 4)};
  return out;
}
#define LOAD(at) NAME(load)(at)
#define MADD(sum, factor, eight) do { const float f_ = (factor); const Eight e_ = (eight); \
  (sum).low += f_ * e_.low; (sum).high += f_ * e_.high; } while (0)
#define LANE(eight, k) ((double)((k) < 4 ? (eight).low[(k) & 3] : (eight).high[(k) & 3]))
#define ZERO8 {{0}, {0}}
#else
typedef struct { float lane[8]; } Eight;
INLINE Eight NAME(load)(const float *at) {
  Eight out;
  memcpy(out.lane, at, sizeof out.lane);
  return out;
}
#define LOAD(at) NAME(load)(at)
#define MADD(sum, factor, eight) do { const float f_ = (factor); const Eight e_ = (eight); \
  for (int k_ = 0; k_ < 8; ++k_) (sum).lane[k_] += f_ * e_.lane[k_]; } while (0)
#define LANE(eight, k) ((double)(eight).lane[k])
#define ZERO8 {{0}}
#endif

/* The inverse of a symmetric matrix xx, xy, xz, yy, yz, zz; 0 where it is singular, or hardly is not. */
INLINE int NAME(invert)(const double A[6], double out[6]) {
  const double a = A[3] * A[5] - A[4] * A[4], b = A[2] * A[4] - A[1] * A[5], c = A[1] * A[4] - A[2] * A[3];
  const double det = A[0] * a + A[1] * b + A[2] * c;
  const double f = 1 / det;
  out[0] = a * f; out[1] = b * f; out[2] = c * f;
  out[3] = (A[0] * A[5] - A[2] * A[2]) * f;
  out[4] = (A[1] * A[2] - A[0] * A[4]) * f;
  out[5] = (A[0] * A[3] - A[1] * A[1]) * f;
  return (det > 0) & ((out[0] + out[3] + out[5]) * (A[0] + A[3] + A[5]) < 1e9); /* the condition number */
}

INLINE void NAME(times)(const double A[6], const double x[3], double out[3]) {
  out[0] = A[0] * x[0] + A[1] * x[1] + A[2] * x[2];
  out[1] = A[1] * x[0] + A[3] * x[1] + A[4] * x[2];
  out[2] = A[2] * x[0] + A[4] * x[1] + A[5] * x[2];
}

/* The same of a block of points, which the compiler makes vectors of. */
INLINE void NAME(invert_block)(double A[6][BLOCK], double out[6][BLOCK], double good[BLOCK]) {
  for (int k = 0; k < BLOCK; ++k) {
    const double a = A[3][k] * A[5][k] - A[4][k] * A[4][k], b = A[2][k] * A[4][k] - A[1][k] * A[5][k];
    const double c = A[1][k] * A[4][k] - A[2][k] * A[3][k];
    const double det = A[0][k] * a + A[1][k] * b + A[2][k] * c, f = 1 / det;
    out[0][k] = a * f; out[1][k] = b * f; out[2][k] = c * f;
    out[3][k] = (A[0][k] * A[5][k] - A[2][k] * A[2][k]) * f;
    out[4][k] = (A[1][k] * A[2][k] - A[0][k] * A[4][k]) * f;
    out[5][k] = (A[0][k] * A[3][k] - A[1][k] * A[1][k]) * f;
    const double condition = (out[0][k] + out[3][k] + out[5][k]) * (A[0][k] + A[3][k] + A[5][k]);
    good[k] = (det > 0 ? 1.0 : 0.0) * (condition < 1e9 ? 1.0 : 0.0);
  }
}

INLINE void NAME(times_block)(double A[6][BLOCK], double x[3][BLOCK], double out[3][BLOCK]) {
  for (int k = 0; k < BLOCK; ++k) {
    out[0][k] = A[0][k] * x[0][k] + A[1][k] * x[1][k] + A[2][k] * x[2][k];
    out[1][k] = A[1][k] * x[0][k] + A[3][k] * x[1][k] + A[4][k] * x[2][k];
    out[2][k] = A[2][k] * x[0][k] + A[4][k] * x[1][k] + A[5][k] * x[2][k];
  }
}

static double NAME(quadratic)(const double M[3], const double b[2]) { /* b^T M^-1 b, -1 where there is none */
  const double det = M[0] * M[2] - M[1] * M[1];
  if (!(det > 0)) return -1;
  return (M[2] * b[0] * b[0] - 2 * M[1] * b[0] * b[1] + M[0] * b[1] * b[1]) / det;
}

/* Weights of uniform cubic B-splines at the part f of a cell, and their slopes by f. */
INLINE void NAME(weights)(double part, float w[4], float d[4]) {
  const float f = (float)part, g = (float)(1 - part), sixth = 1.0f / 6;
  w[0] = g * g * g * sixth;
  w[1] = ((3 * f - 6) * f * f + 4) * sixth;
  w[2] = (((-3 * f + 3) * f + 3) * f + 1) * sixth;
  w[3] = f * f * f * sixth;
  d[0] = -0.5f * g * g;
  d[1] = (1.5f * f - 2) * f;
  d[2] = (-1.5f * f + 1) * f + 0.5f;
  d[3] = 0.5f * f * f;
}

/* The line of sight of a view; 0 where the table has none. */
INLINE int NAME(sight)(const Map *map, const Seen *seen, View *view) {
  const double *frame = map->sight_frames + 4 * seen->camera;
  const int64_t L = map->sight_cells;
  const double tu = (seen->u - frame[0]) * frame[2], tv = (seen->v - frame[1]) * frame[3];
  if (!(tu >= 0 && tv >= 0 && tu <= (double)L && tv <= (double)L)) return 0;
  int64_t iu = (int64_t)tu, iv = (int64_t)tv;
  if (iu >= L) iu = L - 1;
  if (iv >= L) iv = L - 1;
  float wu[4], wv[4], unused[4];
  NAME(weights)(tu - (double)iu, wu, unused);
  NAME(weights)(tv - (double)iv, wv, unused);
  const float *at = map->sight + ((seen->camera * (L + 3) + iv) * (L + 3) + iu) * WIDTH;
  Eight sum = ZERO8;
  for (int j = 0; j < 4; ++j) {
    const float *row = at + j * (L + 3) * WIDTH;
    Eight along = ZERO8;
    for (int i = 0; i < 4; ++i) MADD(along, wu[i], LOAD(row + i * WIDTH));
    MADD(sum, wv[j], along);
  }
  double d[3], squares = 0, *A = view->across;
  for (int a = 0; a < 3; ++a) {
    view->near_point[a] = LANE(sum, a);
    d[a] = LANE(sum, 3 + a) - view->near_point[a];
    squares += d[a] * d[a];
  }
  if (!(squares > 0)) return 0;
  const double f = 1 / squares;
  for (int a = 0; a < 3; ++a) view->along[a] = d[a] * f;
  view->pixel[0] = LANE(sum, 6);
  view->pixel[1] = LANE(sum, 7);
  A[0] = 1 - d[0] * d[0] * f; A[1] = -d[0] * d[1] * f; A[2] = -d[0] * d[2] * f;
  A[3] = 1 - d[1] * d[1] * f; A[4] = -d[1] * d[2] * f; A[5] = 1 - d[2] * d[2] * f;
  NAME(times)(A, view->near_point, view->across_near);
  return 1;
}

/* The weight of a line of sight for a point so far along it, 0 at the near point and 1 at the far one. */
INLINE double NAME(weight_at)(const Seen *seen, const View *view, double part) {
  const double pixel = view->pixel[0] + part * (view->pixel[1] - view->pixel[0]);
  return 1 / (seen->variance * pixel * pixel);
}

INLINE void NAME(add_line)(const View *view, double weight, double A[6], double b[3]) {
  for (int k = 0; k < 6; ++k) A[k] += weight * view->across[k];
  for (int k = 0; k < 3; ++k) b[k] += weight * view->across_near[k];
}

/* Where the lines of sight of the views in use meet best; 0 for nowhere. */
static int NAME(meet)(const View *views, int64_t m, double x[3]) {
  double A[6] = {0}, b[3] = {0}, inverse[6];
  for (int64_t i = 0; i < m; ++i) {
    if (!views[i].used) continue;
    NAME(add_line)(views + i, views[i].weight, A, b);
  }
  if (!NAME(invert)(A, inverse)) return 0;
  NAME(times)(inverse, b, x);
  return 1;
}

/* Where a place lies in the table. */
typedef struct {
  const float *corner;             /* of its cell, in the grid */
  const uint8_t *marks;            /* of its cell, null where nothing is marked */
  int64_t node, sx, sy, sz;        /* number of the first node; strides in the grid */
  float w[3][4], d[3][4];
} NAME(Spot);

/* Returns 0 outside of the box. */
INLINE int NAME(find)(const Map *map, const double x[3], NAME(Spot) *spot) {
  int64_t cell[3];
  for (int a = 0; a < 3; ++a) {
    const double t = (x[a] - map->low[a]) * map->per_length[a];
    if (!(t >= 0 && t <= (double)map->cells[a])) return 0;
    cell[a] = (int64_t)t;
    if (cell[a] >= map->cells[a]) cell[a] = map->cells[a] - 1;
    NAME(weights)(t - (double)cell[a], spot->w[a], spot->d[a]);
  }
  spot->sz = map->cameras * WIDTH;
  spot->sy = (map->cells[2] + 3) * spot->sz;
  spot->sx = (map->cells[1] + 3) * spot->sy;
  spot->node = (cell[0] * (map->cells[1] + 3) + cell[1]) * (map->cells[2] + 3) + cell[2];
  spot->corner = map->grid + spot->node * spot->sz;
  spot->marks = map->marked
      ? map->marked + ((cell[0] * map->cells[1] + cell[1]) * map->cells[2] + cell[2]) * map->cameras : NULL;
  return 1;
}

/* What a camera sees there: the residual of a view and its slope, and the variance without noise, uu, uv, vv. */
INLINE void NAME(look)(const Map *map, const NAME(Spot) *spot, const Seen *seen, const double x[3], double r[2],
                       double D[2][3], double S[3]) {
  const float *base = spot->corner + seen->camera * WIDTH;
  const int64_t sx = spot->sx, sy = spot->sy, sz = spot->sz;
  const float (*w)[4] = spot->w, (*d)[4] = spot->d;
  Eight value = ZERO8, by_x = ZERO8, by_y = ZERO8, by_z = ZERO8;
  for (int p = 0; p < 4; ++p) {
    Eight a = ZERO8, ay = ZERO8, az = ZERO8;
    const float *plane = base + p * sx;
    for (int q = 0; q < 4; ++q) {
      const float *row = plane + q * sy;
      const Eight n0 = LOAD(row), n1 = LOAD(row + sz), n2 = LOAD(row + 2 * sz), n3 = LOAD(row + 3 * sz);
      Eight along = ZERO8, slope = ZERO8;
      MADD(along, w[2][0], n0); MADD(along, w[2][1], n1); MADD(along, w[2][2], n2); MADD(along, w[2][3], n3);
      MADD(slope, d[2][0], n0); MADD(slope, d[2][1], n1); MADD(slope, d[2][2], n2); MADD(slope, d[2][3], n3);
      MADD(a, w[1][q], along);
      MADD(ay, d[1][q], along);
      MADD(az, w[1][q], slope);
    }
    MADD(value, w[0][p], a);
    MADD(by_x, d[0][p], a);
    MADD(by_y, w[0][p], ay);
    MADD(by_z, w[0][p], az);
  }
  const double *P = map->projections + 12 * seen->camera;
  const double depth = 1 / (P[8] * x[0] + P[9] * x[1] + P[10] * x[2] + P[11]);
  const double uv[2] = {(P[0] * x[0] + P[1] * x[1] + P[2] * x[2] + P[3]) * depth,
                        (P[4] * x[0] + P[5] * x[1] + P[6] * x[2] + P[7]) * depth};
  for (int k = 0; k < 2; ++k) {
    r[k] = (k ? seen->v : seen->u) - uv[k] - LANE(value, k);
    const double slopes[3] = {LANE(by_x, k), LANE(by_y, k), LANE(by_z, k)};
    for (int a = 0; a < 3; ++a) D[k][a] = (P[4 * k + a] - uv[k] * P[8 + a]) * depth + slopes[a] * map->per_length[a];
  }
  S[0] = LANE(value, 2);
  S[1] = LANE(value, 3);
  S[2] = LANE(value, 4);
}

/* H (six numbers) += f D^T E of two rows each. */
INLINE void NAME(add)(double H[6], double f, const double D[2][3], const double E[2][3]) {
  H[0] += f * (D[0][0] * E[0][0] + D[1][0] * E[1][0]);
  H[1] += f * (D[0][0] * E[0][1] + D[1][0] * E[1][1]);
  H[2] += f * (D[0][0] * E[0][2] + D[1][0] * E[1][2]);
  H[3] += f * (D[0][1] * E[0][1] + D[1][1] * E[1][1]);
  H[4] += f * (D[0][1] * E[0][2] + D[1][1] * E[1][2]);
  H[5] += f * (D[0][2] * E[0][2] + D[1][2] * E[1][2]);
}

/* The normal equations of the views of a point at a place: H, g and squares; N is H by the noise alone. With `views`,
   only those in use count, and what is found of each is kept, with `all` of the others, too. Returns 0 outside of the
   box, and where the table is not accurate enough. */
INLINE int NAME(normal)(const Map *map, const Seen *seen, View *views, int64_t m, const double x[3], int all,
                        double H[6], double g[3], double N[6], double *squares) {
  NAME(Spot) spot;
  if (!NAME(find)(map, x, &spot)) return 0;
  for (int k = 0; k < 6; ++k) H[k] = N[k] = 0;
  g[0] = g[1] = g[2] = 0;
  double sum = 0;
  for (int64_t i = 0; i < m; ++i) {
    if (views && !views[i].used && !all) continue;
    if (spot.marks && spot.marks[seen[i].camera]) return 0;
    double r[2], D[2][3], WD[2][3], S[3];
    NAME(look)(map, &spot, seen + i, x, r, D, S);
    const double variance = seen[i].variance, S0 = S[0] + variance, S1 = S[1], S2 = S[2] + variance;
    const double both = S0 * S2 - S1 * S1, f = 1 / (both * variance), less = both * f, inverse = variance * f;
    const double W0 = S2 * inverse, W1 = -S1 * inverse, W2 = S0 * inverse; /* less is 1 / variance */
    const double Wr0 = W0 * r[0] + W1 * r[1], Wr1 = W1 * r[0] + W2 * r[1], distance = r[0] * Wr0 + r[1] * Wr1;
    if (!(both > 0)) return 0;
    for (int a = 0; a < 3; ++a) {
      WD[0][a] = W0 * D[0][a] + W1 * D[1][a];
      WD[1][a] = W1 * D[0][a] + W2 * D[1][a];
    }
    if (views) {
      View *view = views + i;
      view->W[0] = W0; view->W[1] = W1; view->W[2] = W2;
      view->Wr[0] = Wr0; view->Wr[1] = Wr1;
      view->distance = distance;
      memcpy(view->D, D, sizeof D);
      memcpy(view->WD, WD, sizeof WD);
      if (!view->used) continue;
    }
    NAME(add)(H, 1, D, WD);
    NAME(add)(N, less, D, D);
    for (int a = 0; a < 3; ++a) g[a] += D[0][a] * Wr0 + D[1][a] * Wr1;
    sum += distance;
  }
  *squares = sum;
  return isfinite(sum);
}

/* The same of cameras that are tied together: the covariance of all views of a point is one matrix. tied: D^T S^-1 times
   the covariance of what the cameras would see with the unknowns of the labels, [3][unknowns]. room: for (2 m)^2 +
   (4 + unknowns) 2 m numbers. */
static int NAME(normal_tied)(const Map *map, const Seen *seen, int64_t m, const double x[3], double H[6], double g[3],
                             double N[6], double *squares, double *tied, double *room) {
  NAME(Spot) spot;
  if (!NAME(find)(map, x, &spot)) return 0;
  const int64_t n = 2 * m, C = map->cameras, K = map->unknowns, pairs = C * (C - 1) / 2, columns = 4 + K;
  double *L = room, *B = room + n * n; /* B: slope, residual, and unknowns of each row */
  float w[64];
  int64_t nodes[64];
  for (int p = 0; p < 4; ++p)
    for (int q = 0; q < 4; ++q)
      for (int s = 0; s < 4; ++s) {
        w[(p * 4 + q) * 4 + s] = spot.w[0][p] * spot.w[1][q] * spot.w[2][s];
        nodes[(p * 4 + q) * 4 + s] = spot.node + (p * (map->cells[1] + 3) + q) * (map->cells[2] + 3) + s;
      }
  for (int k = 0; k < 6; ++k) N[k] = 0;
  for (int64_t i = 0; i < m; ++i) {
    const int64_t c = seen[i].camera;
    if (spot.marks && spot.marks[c]) return 0;
    double r[2], D[2][3], S[3];
    NAME(look)(map, &spot, seen + i, x, r, D, S);
    NAME(add)(N, 1 / seen[i].variance, D, D);
    L[2 * i * n + 2 * i] = S[0] + seen[i].variance;
    L[(2 * i + 1) * n + 2 * i] = S[1];
    L[(2 * i + 1) * n + 2 * i + 1] = S[2] + seen[i].variance;
    for (int64_t j = 0; j < i; ++j) { /* camera of j before c: the table has rows of it, and columns of c */
      const int64_t b = seen[j].camera, pair = b * (2 * C - b - 1) / 2 + c - b - 1;
      float sum[4] = {0};
      for (int node = 0; node < 64; ++node) {
        const float *at = map->ties + (nodes[node] * pairs + pair) * 4;
        for (int l = 0; l < 4; ++l) sum[l] += w[node] * at[l];
      }
      L[2 * i * n + 2 * j] = sum[0];
      L[(2 * i + 1) * n + 2 * j] = sum[1];
      L[2 * i * n + 2 * j + 1] = sum[2];
      L[(2 * i + 1) * n + 2 * j + 1] = sum[3];
    }
    for (int k = 0; k < 2; ++k) {
      double *row = B + (2 * i + k) * columns;
      for (int a = 0; a < 3; ++a) row[a] = D[k][a];
      row[3] = r[k];
      for (int64_t l = 0; l < K; ++l) row[4 + l] = 0;
      for (int node = 0; node < 64 && K; ++node) {
        const float *at = map->through + ((nodes[node] * C + c) * 2 + k) * K;
        for (int64_t l = 0; l < K; ++l) row[4 + l] += (double)w[node] * (double)at[l];
      }
    }
  }
  for (int64_t i = 0; i < n; ++i) { /* Cholesky, and L^-1 B at once */
    double *own = L + i * n, *row = B + i * columns;
    for (int64_t j = 0; j <= i; ++j) {
      double sum = own[j];
      for (int64_t k = 0; k < j; ++k) sum -= own[k] * L[j * n + k];
      if (j < i) {
        own[j] = sum * L[j * n + j]; /* of the diagonal, the inverse is kept */
        continue;
      }
      if (!(sum > 0)) return 0;
      own[i] = 1 / sqrt(sum);
    }
    for (int64_t k = 0; k < i; ++k)
      for (int64_t l = 0; l < columns; ++l) row[l] -= own[k] * B[k * columns + l];
    for (int64_t l = 0; l < columns; ++l) row[l] *= own[i];
  }
  for (int k = 0; k < 6; ++k) H[k] = 0;
  g[0] = g[1] = g[2] = *squares = 0;
  for (int64_t l = 0; l < 3 * K; ++l) tied[l] = 0;
  for (int64_t i = 0; i < n; ++i) {
    const double *row = B + i * columns;
    H[0] += row[0] * row[0]; H[1] += row[0] * row[1]; H[2] += row[0] * row[2];
    H[3] += row[1] * row[1]; H[4] += row[1] * row[2]; H[5] += row[2] * row[2];
    for (int a = 0; a < 3; ++a) {
      g[a] += row[a] * row[3];
      for (int64_t l = 0; l < K; ++l) tied[a * K + l] += row[a] * row[4 + l];
    }
    *squares += row[3] * row[3];
  }
  return isfinite(*squares);
}

static int NAME(normal_of_views)(const Map *map, const Seen *seen, View *views, int64_t m, const double x[3], int all,
                                 double H[6], double g[3], double N[6], double *squares) {
  return NAME(normal)(map, seen, views, m, x, all, H, g, N, squares);
}

typedef struct {
  double x[3], cov[6], p, share;
} NAME(Place);

INLINE int NAME(in_box)(const Map *map, const double x[3]) {
  for (int a = 0; a < 3; ++a) {
    const double t = (x[a] - map->low[a]) * map->per_length[a];
    if (!(t >= 0 && t <= (double)map->cells[a])) return 0;
  }
  return 1;
}

/* Share of the variance that perfectly known cameras would not have, eq. (22a); N: H by the noise alone. */
INLINE double NAME(share)(const double N[6], const double cov[6]) {
  double inverse[6];
  if (!NAME(invert)(N, inverse)) return NAN;
  const double share = 1 - (inverse[0] + inverse[3] + inverse[5]) / (cov[0] + cov[3] + cov[5]);
  return share < 0 ? 0 : share > 1 ? 1 : share;
}

/* A point from the views in use, from x, eqs. (20) and (21); 0 where the tables cannot say. */
static int NAME(solve)(const Map *map, const Seen *seen, View *views, int64_t m, const double start[3], NAME(Place) *out) {
  double H[6], g[3], N[6], squares, step[3], x[3] = {start[0], start[1], start[2]};
  int64_t used = 0;
  for (int64_t i = 0; i < m; ++i) used += views[i].used;
  for (int number = 0; number < MAX_STEPS; ++number) {
    if (!NAME(normal_of_views)(map, seen, views, m, x, 0, H, g, N, &squares) || !NAME(invert)(H, out->cov)) return 0;
    NAME(times)(out->cov, g, step);
    const double size = step[0] * g[0] + step[1] * g[1] + step[2] * g[2];
    for (int a = 0; a < 3; ++a) x[a] += step[a];
    if (size < map->step_sds * map->step_sds) {
      if (!NAME(in_box)(map, x)) return 0;
      for (int a = 0; a < 3; ++a) out->x[a] = x[a];
      out->p = survival(squares - size, 2 * used - 3);
      out->share = NAME(share)(N, out->cov);
      return 1;
    }
  }
  return 0;
}

/* Squared distance of a place from a line of sight. */
INLINE double NAME(off_line)(const View *view, const double x[3]) {
  const double from[3] = {x[0] - view->near_point[0], x[1] - view->near_point[1], x[2] - view->near_point[2]};
  double across[3];
  NAME(times)(view->across, from, across);
  return from[0] * across[0] + from[1] * across[1] + from[2] * across[2];
}

/* The sum of the smallest `trusted` distances of a place from lines, and the largest of these. */
static double NAME(trimmed)(View *views, int64_t m, int64_t trusted, const double x[3], double *largest) {
  double sum = 0, last = -1;
  for (int64_t i = 0; i < m; ++i) views[i].distance = NAME(off_line)(views + i, x);
  for (int64_t k = 0; k < trusted; ++k) { /* few views: a selection is as good as a sort */
    double next = INFINITY;
    int64_t equal = 0;
    for (int64_t i = 0; i < m; ++i) {
      if (views[i].distance > last && views[i].distance < next) next = views[i].distance;
    }
    for (int64_t i = 0; i < m; ++i) equal += views[i].distance == next;
    if (!isfinite(next)) break;
    for (; equal > 1 && k + 1 < trusted; --equal, ++k) sum += next;
    sum += next;
    last = next;
  }
  *largest = last;
  return sum;
}

/* The place that most lines of sight agree on: least trimmed squares, eq. (W1). Views near it are then in use. */
static int NAME(majority)(View *views, int64_t m, int64_t trusted, double x[3]) {
  double best = INFINITY, tried[3], largest;
  int64_t pairs = 0;
  for (int64_t apart = 1; apart < m && pairs < MAX_RAY_PAIRS; ++apart)
    for (int64_t i = 0; i + apart < m && pairs < MAX_RAY_PAIRS; ++i, ++pairs) {
      for (int64_t k = 0; k < m; ++k) views[k].used = k == i || k == i + apart;
      if (!NAME(meet)(views, m, tried)) continue;
      const double sum = NAME(trimmed)(views, m, trusted, tried, &largest);
      if (!(sum < best)) continue;
      best = sum;
      for (int a = 0; a < 3; ++a) x[a] = tried[a];
    }
  if (!isfinite(best)) return 0;
  for (int again = 0; again < 2; ++again) {
    NAME(trimmed)(views, m, trusted, x, &largest);
    for (int64_t k = 0; k < m; ++k) views[k].used = views[k].distance <= largest;
    if (!NAME(meet)(views, m, x)) return 0;
  }
  return 1;
}

/* Views that are left out; -1 for none. */
typedef struct {
  int64_t first, second;
  double chi2;
} NAME(Group);

INLINE void NAME(keep_two)(NAME(Group) best[2], int64_t first, int64_t second, double chi2) {
  if (first > second && second >= 0) {
    const int64_t other = first;
    first = second;
    second = other;
  }
  for (int k = 0; k < 2; ++k)
    if (best[k].first == first && best[k].second == second) return;
  const NAME(Group) made = {first, second, chi2};
  if (chi2 < best[0].chi2) {
    best[1] = best[0];
    best[0] = made;
  } else if (chi2 < best[1].chi2) {
    best[1] = made;
  }
}

/* The two groups of `size` views without which chi-squared is smallest, in closed form, eq. (W2). */
static void NAME(two_best)(const Map *map, View *views, int64_t m, int size, const double inverse[6], double squares,
                           NAME(Group) best[2]) {
  best[0] = best[1] = (NAME(Group)){-1, -1, INFINITY};
  if (size == 1) {
    for (int64_t i = 0; i < m; ++i) {
      const double less = NAME(quadratic)(views[i].M, views[i].b);
      if (less >= 0) NAME(keep_two)(best, i, -1, squares - less > 0 ? squares - less : 0);
    }
    return;
  }
  for (int64_t place = 0; place < map->suspects_of_two && place < m; ++place) {
    int64_t suspect = -1; /* the next farthest; `used` marks those that were */
    for (int64_t i = 0; i < m; ++i)
      if (views[i].used && (suspect < 0 || views[i].distance > views[suspect].distance)) suspect = i;
    if (suspect < 0) return;
    views[suspect].used = 0;
    const View *s = views + suspect;
    const double less = NAME(quadratic)(s->M, s->b), det = s->M[0] * s->M[2] - s->M[1] * s->M[1];
    if (!(less >= 0)) continue;
    const double V0 = s->M[2] / det, V1 = -s->M[1] / det, V2 = s->M[0] / det; /* M_ss^-1 */
    double through[2][3];
    for (int k = 0; k < 2; ++k) NAME(times)(inverse, s->WD[k], through[k]);
    for (int64_t i = 0; i < m; ++i) {
      if (i == suspect) continue;
      double K[2][2], T[2][2], M[3], b[2]; /* K = M_is = -W D H^-1 D^T W */
      for (int k = 0; k < 2; ++k)
        for (int l = 0; l < 2; ++l)
          K[k][l] = -(views[i].WD[k][0] * through[l][0] + views[i].WD[k][1] * through[l][1] +
                      views[i].WD[k][2] * through[l][2]);
      for (int k = 0; k < 2; ++k) {
        T[k][0] = K[k][0] * V0 + K[k][1] * V1;
        T[k][1] = K[k][0] * V1 + K[k][1] * V2;
        b[k] = views[i].b[k] - T[k][0] * s->b[0] - T[k][1] * s->b[1];
      }
      M[0] = views[i].M[0] - T[0][0] * K[0][0] - T[0][1] * K[0][1];
      M[1] = views[i].M[1] - T[0][0] * K[1][0] - T[0][1] * K[1][1];
      M[2] = views[i].M[2] - T[1][0] * K[1][0] - T[1][1] * K[1][1];
      const double more = NAME(quadratic)(M, b), chi2 = squares - less - more;
      if (more >= 0) NAME(keep_two)(best, suspect, i, chi2 > 0 ? chi2 : 0);
    }
  }
}

static int NAME(solve_without)(const Map *map, const Seen *seen, View *views, int64_t m, NAME(Group) out, NAME(Place) *found) {
  double x[3];
  for (int64_t i = 0; i < m; ++i) views[i].used = i != out.first && i != out.second;
  return NAME(meet)(views, m, x) && NAME(in_box)(map, x) && NAME(solve)(map, seen, views, m, x, found);
}

/* Whether a p-value is so near a limit that the exact path, which has it by some thousandths otherwise, must say. */
INLINE int NAME(near)(double p, double limit) { return p > 0.95 * limit && p < 1.05 * limit; }

/* Whether the best choice of wrong views is clear. */
INLINE int NAME(clear)(const Map *map, double best, double second) {
  if (NAME(near)(best, map->agree_p) || NAME(near)(best, map->clearly_better * second)) return UNSURE;
  return best > map->agree_p && best > map->clearly_better * second ? MENDED : NOT_CLEAR;
}

/* Three views: the three pairs are tried. Leaves in use what is kept. */
static int NAME(try_each)(const Map *map, const Seen *seen, View *views, NAME(Place) *found) {
  NAME(Place) tried;
  double best = 0, second = 0;
  int64_t out = -1;
  for (int64_t i = 0; i < 3; ++i) {
    if (!NAME(solve_without)(map, seen, views, 3, (NAME(Group)){i, -1, 0}, &tried)) return UNSURE;
    if (tried.p > best) {
      second = best;
      best = tried.p;
      out = i;
      *found = tried;
    } else if (tried.p > second) {
      second = tried.p;
    }
  }
  for (int64_t i = 0; i < 3; ++i) views[i].used = i != out;
  return NAME(clear)(map, best, second);
}

/* The one view, or the two, without which the others agree, where that is clear, eqs. (W1) to (W3), as
   rig_model/wrong_views.py finds them. Leaves in use what is kept. */
static int NAME(without_wrong)(const Map *map, const Seen *seen, View *views, int64_t m, NAME(Place) *found) {
  enum { SLACK = 20, HOPELESS = 1000 };
  if (m == 3) return NAME(try_each)(map, seen, views, found);
  double x[3], H[6], g[3], N[6], squares, inverse[6], step[3];
  const int64_t most = m >= 8 ? (m - 2) / 2 : m >= 5 ? 2 : 1;
  if (!NAME(majority)(views, m, m - most, x)) return UNSURE;
  for (int again = 0; again < 2; ++again) {
    if (!NAME(normal_of_views)(map, seen, views, m, x, 0, H, g, N, &squares) || !NAME(invert)(H, inverse)) return UNSURE;
    NAME(times)(inverse, g, step);
    for (int a = 0; a < 3; ++a) x[a] += step[a];
    if (step[0] * g[0] + step[1] * g[1] + step[2] * g[2] < 1) break;
  }
  for (int64_t i = 0; i < m; ++i) views[i].used = 1;
  if (!NAME(normal_of_views)(map, seen, views, m, x, 1, H, g, N, &squares) || !NAME(invert)(H, inverse)) return UNSURE;
  NAME(times)(inverse, g, step);
  squares -= step[0] * g[0] + step[1] * g[1] + step[2] * g[2];
  for (int64_t i = 0; i < m; ++i) {
    View *view = views + i;
    double through[2][3];
    for (int k = 0; k < 2; ++k) {
      NAME(times)(inverse, view->WD[k], through[k]);
      view->b[k] = view->Wr[k] - (view->WD[k][0] * step[0] + view->WD[k][1] * step[1] + view->WD[k][2] * step[2]);
    }
    for (int k = 0; k < 3; ++k) {
      const int a = k == 2, b = k > 0;
      view->M[k] = view->W[k] - (view->WD[a][0] * through[b][0] + view->WD[a][1] * through[b][1] +
                                 view->WD[a][2] * through[b][2]);
    }
  }
  NAME(Group) both[2][2];
  for (int size = 1; size <= (most < 2 ? 1 : 2); ++size)
    NAME(two_best)(map, views, m, size, inverse, squares, both[size - 1]);
  for (int size = 1; size <= (most < 2 ? 1 : 2); ++size) {
    const NAME(Group) *best = both[size - 1];
    if (best[1].first < 0) continue;
    const int64_t degrees = 2 * (m - size) - 3;
    const double p0 = survival(best[0].chi2, degrees) * SLACK, p1 = survival(best[1].chi2, degrees);
    if (!(p0 > map->agree_p && p0 > map->clearly_better * p1)) continue;
    NAME(Place) tried[2];
    if (!NAME(solve_without)(map, seen, views, m, best[0], &tried[0])) return UNSURE;
    int kept = 0;
    double second = 0;
    if (m - size <= 3 || best[1].chi2 < HOPELESS) {
      if (!NAME(solve_without)(map, seen, views, m, best[1], &tried[1])) return UNSURE;
      kept = tried[1].p > tried[0].p;
      second = tried[!kept].p;
    }
    const int clear = NAME(clear)(map, tried[kept].p, second);
    if (clear == UNSURE) return UNSURE;
    if (clear == NOT_CLEAR) continue;
    *found = tried[kept];
    for (int64_t i = 0; i < m; ++i) views[i].used = i != best[kept].first && i != best[kept].second;
    return MENDED;
  }
  return most > 2 ? UNSURE : NOT_CLEAR; /* of eight views, three may be wrong */
}

/* Which views of a point are wrong that has at least three, and whose views disagree or meet nowhere. */
static int NAME(mend)(const Map *map, const Seen *seen, View *views, int64_t m, NAME(Place) *found) {
  for (int64_t i = 0; i < m; ++i) {
    if (!NAME(sight)(map, seen + i, views + i)) return UNSURE;
    views[i].weight = NAME(weight_at)(seen + i, views + i, 0.5);
  }
  return NAME(without_wrong)(map, seen, views, m, found);
}

/* What becomes of a point whose views disagree, and none of which is clearly wrong. */
INLINE int NAME(as_it_is)(const Map *map, double p) {
  return NAME(near)(p, map->min_p) ? LEFT_TO_EXACT : p < map->min_p ? CONTRADICTION : MEASURED;
}

/* The equations of the place where all lines of sight of a point meet, each as heavy as a pixel is short there; 0 where
   one of them is not in the table. */
INLINE int NAME(weighted_lines)(const Map *map, const Seen *seen, View *views, int64_t m, double A[6], double b[3]) {
  double inverse[6], x[3];
  for (int k = 0; k < 6; ++k) A[k] = 0;
  b[0] = b[1] = b[2] = 0;
  for (int64_t i = 0; i < m; ++i) {
    if (!NAME(sight)(map, seen + i, views + i)) return 0;
    NAME(add_line)(views + i, NAME(weight_at)(seen + i, views + i, 0.5), A, b);
  }
  if (m == 2) return 1; /* where two meet, weights hardly matter */
  if (!NAME(invert)(A, inverse)) return 0;
  NAME(times)(inverse, b, x);
  for (int k = 0; k < 6; ++k) A[k] = 0;
  b[0] = b[1] = b[2] = 0;
  for (int64_t i = 0; i < m; ++i) {
    double part = 0;
    for (int a = 0; a < 3; ++a) part += (x[a] - views[i].near_point[a]) * views[i].along[a];
    part = part < -0.5 ? -0.5 : part > 1.5 ? 1.5 : part;
    NAME(add_line)(views + i, NAME(weight_at)(seen + i, views + i, part), A, b);
  }
  return 1;
}

static const int NAME(AT)[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5}; /* of a full matrix in one of six numbers */

INLINE void NAME(put)(const NAME(Place) *found, double *xyz, double *cov, double *p, double *share) {
  for (int a = 0; a < 3; ++a) xyz[a] = found->x[a];
  for (int a = 0; a < 9; ++a) cov[a] = found->cov[NAME(AT)[a]];
  *p = found->p;
  *share = found->share;
}

/* A block of up to BLOCK points. */
static void NAME(block)(const Map *map, int64_t n, const double *uv, const double *noise, int64_t noise_stride,
                        double *xyz, double *cov, double *p, double *share, int8_t *code, uint8_t *left_out,
                        double *tied, Seen *seen, View *views, double *room) {
  const int64_t C = map->cameras;
  double H[6][BLOCK], N[6][BLOCK], inverse[6][BLOCK], by_noise[6][BLOCK], g[3][BLOCK], x[3][BLOCK], step[3][BLOCK];
  double squares[BLOCK], good[BLOCK], fine[BLOCK], place[3], h[6], e[6], f[3];
  int64_t views_of[BLOCK], going[BLOCK], number = 0;
  memset(H, 0, sizeof H);
  memset(N, 0, sizeof N);
  memset(g, 0, sizeof g);
  memset(left_out, 0, (size_t)(n * C));
  for (int64_t k = 0; k < n; ++k) {
    const double *pixels = uv + 2 * C * k, *sd = noise + noise_stride * k;
    Seen *of = seen + C * k;
    int64_t m = 0;
    for (int64_t c = 0; c < C; ++c) {
      const double u = pixels[2 * c], v = pixels[2 * c + 1];
      of[m] = (Seen){u, v, sd[c] * sd[c], c};
      m += isfinite(u + v) != 0;
    }
    views_of[k] = m;
    code[k] = m < 2 ? TOO_FEW_VIEWS : LEFT_TO_EXACT;
    if (m >= 2 && NAME(weighted_lines)(map, of, views, m, h, f)) {
      for (int a = 0; a < 6; ++a) H[a][k] = h[a];
      for (int a = 0; a < 3; ++a) g[a][k] = f[a];
      going[number++] = k;
    }
  }
  NAME(invert_block)(H, inverse, good);
  NAME(times_block)(inverse, g, x);
  int64_t kept = 0;
  for (int64_t j = 0; j < number; ++j)
    if (good[going[j]] > 0) going[kept++] = going[j];
  number = kept;
  for (int steps = 0; steps < MAX_STEPS && number > 0; ++steps) {
    kept = 0;
    for (int64_t j = 0; j < number; ++j) {
      const int64_t k = going[j];
      for (int a = 0; a < 3; ++a) place[a] = x[a][k];
      const int fine_here =
          map->ties ? NAME(normal_tied)(map, seen + C * k, views_of[k], place, h, f, e, squares + k,
                                        tied + 3 * map->unknowns * k, room)
                    : NAME(normal)(map, seen + C * k, NULL, views_of[k], place, 0, h, f, e, squares + k);
      if (!fine_here) continue;
      for (int a = 0; a < 6; ++a) {
        H[a][k] = h[a];
        N[a][k] = e[a];
      }
      for (int a = 0; a < 3; ++a) g[a][k] = f[a];
      going[kept++] = k;
    }
    number = kept;
    NAME(invert_block)(H, inverse, good);
    NAME(invert_block)(N, by_noise, fine);
    NAME(times_block)(inverse, g, step);
    kept = 0;
    for (int64_t j = 0; j < number; ++j) {
      const int64_t k = going[j], m = views_of[k];
      if (!(good[k] > 0)) continue;
      const double size = step[0][k] * g[0][k] + step[1][k] * g[1][k] + step[2][k] * g[2][k];
      for (int a = 0; a < 3; ++a) place[a] = x[a][k] += step[a][k];
      if (!(size < map->step_sds * map->step_sds)) {
        going[kept++] = k;
        continue;
      }
      if (!NAME(in_box)(map, place)) continue;
      p[k] = survival(squares[k] - size, 2 * m - 3);
      code[k] = p[k] >= 1.05 * map->disagree_p ? MEASURED : DISAGREES;
      for (int a = 0; a < 3; ++a) xyz[3 * k + a] = place[a];
      for (int a = 0; a < 9; ++a) cov[9 * k + a] = inverse[NAME(AT)[a]][k];
      const double parts = (by_noise[0][k] + by_noise[3][k] + by_noise[5][k]) /
                           (inverse[0][k] + inverse[3][k] + inverse[5][k]);
      share[k] = !(fine[k] > 0) ? NAN : parts > 1 ? 0 : parts < 0 ? 1 : 1 - parts;
    }
    number = kept;
  }
  for (int64_t k = 0; k < n; ++k) {
    if (code[k] == MEASURED) continue;
    const int64_t m = views_of[k];
    const int solved = code[k] == DISAGREES;
    NAME(Place) found = {{0}, {0}, 0, 0};
    int mended = m > 2 ? UNSURE : NOT_CLEAR;
    if (m > 2 && !map->ties && !(solved && NAME(near)(p[k], map->disagree_p)))
      mended = NAME(mend)(map, seen + C * k, views, m, &found);
    if (mended == MENDED) {
      NAME(put)(&found, xyz + 3 * k, cov + 9 * k, p + k, share + k);
      for (int64_t i = 0; i < m; ++i)
        if (!views[i].used) left_out[C * k + seen[C * k + i].camera] = 1;
      code[k] = MEASURED;
      continue;
    }
    if (solved) code[k] = mended == NOT_CLEAR ? (int8_t)NAME(as_it_is)(map, p[k]) : LEFT_TO_EXACT;
    if (code[k] == MEASURED) continue;
    for (int a = 0; a < 3; ++a) xyz[3 * k + a] = NAN;
    for (int a = 0; a < 9; ++a) cov[9 * k + a] = NAN;
    share[k] = NAN;
    if (code[k] != CONTRADICTION) p[k] = NAN;
  }
}

static void NAME(measure)(const Map *map, int64_t n, const double *uv, const double *noise, int64_t noise_stride,
                          double *xyz, double *cov, double *p, double *share, int8_t *code, uint8_t *left_out,
                          double *tied, void *workspace) {
  const int64_t C = map->cameras;
  View *views = workspace;
  Seen *seen = (Seen *)(views + C);
  double *room = (double *)(seen + C * BLOCK);
  for (int64_t k = 0; k < n; k += BLOCK)
    NAME(block)(map, n - k < BLOCK ? n - k : BLOCK, uv + 2 * C * k, noise + noise_stride * k, noise_stride, xyz + 3 * k,
                cov + 9 * k, p + k, share + k, code + k, left_out + C * k, tied + 3 * map->unknowns * k, seen, views, room);
}

#undef Eight

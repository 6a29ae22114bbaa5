# Error of every method on every system: ours (mean over runs, smallest and largest), and as printed in the paper.
file = dir . '/table1_cells.csv'
systems = system("awk -F, 'NR > 1 && !seen[$1]++ { print $1 }' '" . file . "'")
set multiplot layout 1, words(systems) margins 0.06, 0.99, 0.36, 0.92 spacing 0.06
set logscale y
set grid ytics lc rgb '#dddddd'
set xrange [0.3:7.7]
is(system, protocol) = strcol('system') eq system && strcol('protocol') eq protocol
# rows of other systems must not widen the axes
of(system, protocol, name) = is(system, protocol) ? column(name) : NaN
do for [s in systems] {
  set title s
  if (s eq word(systems, 1)) { set ylabel 'normalised rmse' } else { unset ylabel }
  # one key for all
  if (s eq word(systems, 1)) { set key at screen 0.5, 0.05 center horizontal maxrows 1 } else { unset key }
  set xtics rotate by 40 right noenhanced
  plot for [p in 'default paper'] file \
         using (column('method_index') + (p eq 'default' ? -0.15 : 0)):(of(s, p, 'rmse_mean')):(of(s, p, 'rmse_min')):(of(s, p, 'rmse_max')) \
         with yerrorbars pt (p eq 'default' ? 7 : 5) ps 0.9 lw 2 lc rgb (p eq 'default' ? '#1f77b4' : '#d95f02') title p.' protocol', \
       for [p in 'default paper'] file \
         using (column('method_index') + 0.15):(of(s, p, 'printed_rmse_mean')):(of(s, p, 'printed_rmse_min')):(of(s, p, 'printed_rmse_max')) \
         with yerrorbars pt 6 ps 0.9 lw 1 lc rgb '#555555' title (p eq 'default' ? 'printed' : ''), \
       for [p in 'default paper'] file \
         using 'method_index':(of(s, p, 'rmse_mean')):xticlabel(strcol('method')) with dots lc rgb 'white' notitle
}
unset multiplot
